"""The generic names of the packages resolve to this project, and the project says what it is."""

from __future__ import annotations

import importlib
import tomllib
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

import sitegrid

PACKAGES = ("protocol", "agents", "mapserver", "sim", "sitegrid", "evaluation", "benchmarks")


@pytest.mark.parametrize("name", PACKAGES)
def test_each_name_resolves_to_this_project(name: str, root: Path):
    module = importlib.import_module(name)
    assert Path(module.__file__).parent == root / name
    assert module.__doc__


def test_it_is_never_uploaded_and_has_its_extras(root: Path):
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    assert "Private :: Do Not Upload" in project["classifiers"]
    assert set(project["optional-dependencies"]) == {
        *(
            "agent",
            "archive",
            "cluster",
            "postgres",
            "server",
            "sim",
            "entries",
            "eval",
            "web",
            "export",
            "ros",
            "bench",
            "oracle",
            "paper",
            "security",
            "all",
            "dev",
        )
    }
    base = {requirement.split(">")[0] for requirement in project["dependencies"]}
    assert base == {"eclipse-zenoh", "msgpack", "numpy"}


def test_pins_are_exact_and_name_no_host(root: Path):
    lines = [line for line in (root / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert all("==" in line and "/" not in line and "@" not in line for line in lines)


@pytest.mark.parametrize("name", PACKAGES)
def test_each_package_is_typed(name: str, root: Path):
    data = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"]["package-data"]
    assert data["*"] == ["py.typed"]
    assert (root / name / "py.typed").read_text() == ""


def test_everything_that_a_client_meets_stands_under_sitegrid():
    methods = [method for name, method in vars(sitegrid.Client).items() if not name.startswith("_")]
    hints = [get_type_hints(method).get("return") for method in methods if callable(method)]
    answers = {part.__name__ for hint in hints for part in (hint, *get_args(hint)) if isinstance(part, type)}
    assert {"MapInfo", "MachineState", "GroundChange", "Region", "HistorySpan", "TrustAnswer"} <= answers
    assert answers - {"NoneType", "list", "tuple"} <= {*sitegrid.__all__}
    assert all(getattr(sitegrid, name) for name in (*sitegrid.__all__, "__version__"))
