"""Generic package names resolve to this project, which describes itself."""

from __future__ import annotations

import importlib
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import get_args, get_type_hints

import pytest

import sitegrid

PACKAGES = ("protocol", "agents", "mapserver", "sim", "sitegrid", "lab")


@pytest.mark.parametrize("name", PACKAGES)
def test_each_name_resolves_to_this_project(name: str, root: Path):
    module = importlib.import_module(name)
    assert Path(module.__file__).parent == root / name
    assert module.__doc__


def test_it_is_never_uploaded_and_the_readme_names_its_extras(root: Path):
    project = tomllib.loads((root / "pyproject.toml").read_text())["project"]
    assert "Private :: Do Not Upload" in project["classifiers"]
    assert f"\nversion: {project['version']}\n" in (root / "CITATION.cff").read_text()
    readme = (root / "README.md").read_text()
    assert all(f"`.[{extra}]`" in readme for extra in project["optional-dependencies"])
    assert all(project["optional-dependencies"].values()), "none is empty"
    base = {requirement.split(">")[0] for requirement in project["dependencies"]}
    assert base == {"eclipse-zenoh", "msgpack", "numpy"}


def test_make_refuses_another_python_in_one_sentence_and_installs_nothing(root: Path, tmp_path: Path):
    python, venv = tmp_path / "python", tmp_path / "venv"
    python.write_text('#!/bin/sh\n[ "$1" = --version ] && echo Python 3.14.0\nexit 1\n')
    python.chmod(0o755)
    command = ["make", "--silent", "demo", f"PYTHON={python}", f"VENV={venv}"]
    made = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    assert made.returncode == 2
    sentence, _ = made.stderr.splitlines()  # and make's own line
    assert sentence.startswith(f"Python 3.11, 3.12 or 3.13 is needed, and '{python}' is Python 3.14.0")
    assert (made.stdout, venv.exists()) == ("", False)


def test_beside_the_clone_the_package_is_imported_and_not_the_folder(root: Path, tmp_path: Path):
    if not any((Path(sys.prefix) / stamp).exists() for stamp in (".dev", ".demo")):
        pytest.skip("this Python's environment was not made by `make`")
    (tmp_path / "sitegrid").mkdir()  # like a clone's folder
    code = "import sitegrid; print(sitegrid.__file__)"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env={}, capture_output=True, text=True, check=True
    )
    assert Path(done.stdout.strip()) == root / "sitegrid" / "__init__.py"


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
    assert {"MapInfo", "MachineState", "GroundChange", "MapRegion", "Region", "TrustAnswer"} <= answers
    assert {part for part in answers if part[0].isupper()} - {"Any", "NoneType"} <= {*sitegrid.__all__}
    for query in sitegrid.QUERIES.values():
        (answer,) = {part for base in query.__orig_bases__ for part in get_args(base)} or {query}
        assert {query.__name__, answer.__name__} - {"PieceQuery", "AliveQuery"} <= {*sitegrid.__all__}, query
    assert all(getattr(sitegrid, name) for name in (*sitegrid.__all__, "__version__"))
