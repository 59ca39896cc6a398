"""Wheel, source distribution, pins and bill of materials, tried outside of the checkout."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib.metadata import distributions
from itertools import chain
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from tests.paths import ROOT
from tests.release.images import MOUNTS, NEEDS_TOOLS, Images
from tests.release.stores import version

pytestmark = [pytest.mark.processes, pytest.mark.nightly]
GLIBC = (28, 27, 26, 24, 17, 12, 5)  # 2.28 and what runs with it
IN_DEBIAN_13 = """
cd /root
python3 -m venv venv
venv/bin/pip install --quiet --no-cache-dir --constraint /given/constraints.txt "$(echo /given/sitegrid-*.whl)[demo]"
venv/bin/python --version
timeout 1200 venv/bin/sitegrid demo --headless --seconds 120 2>&1
"""
PACKAGES = ("protocol", "agents", "mapserver", "sim", "sitegrid")


def run(*words: str | Path, folder: Path, **environment: str) -> str:
    inherited = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}  # of the checkout
    line, env = [*map(str, words)], inherited | environment
    done = subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"{words}: {done.stdout[-1000:]}{done.stderr[-2000:]}"
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the source distribution of what Git knows, so that nothing else can get into it."""
    folder = tmp_path_factory.mktemp("packages")
    names = run("git", "ls-files", "-z", folder=ROOT).split("\0")
    for name in filter(None, names):
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / "source" / name)
    run(sys.executable, "-m", "venv", folder / "builder", folder=folder)
    python = folder / "builder" / "bin" / "python"
    run(python, "-m", "pip", "install", "--quiet", "setuptools>=77", folder=folder)
    code = "import setuptools.build_meta as backend; backend.build_sdist('../dist')"
    run(python, "-c", code, folder=folder / "source")
    (source,) = (folder / "dist").glob("sitegrid-*.tar.gz")
    run(python, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", source, folder=folder)
    (wheel,) = folder.glob("sitegrid-*.whl")
    return wheel


def test_a_wheel_of_the_source_distribution_runs_a_demo_far_from_the_checkout(wheel: Path, tmp_path: Path) -> None:
    site = tmp_path / "site"
    run(sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", site, wheel, folder=tmp_path)
    code = f"import {', '.join(PACKAGES)}; print(*(one.__file__ for one in ({', '.join(PACKAGES)})))"
    places = run(sys.executable, "-c", code, folder=tmp_path, PYTHONPATH=str(site)).split()
    assert [Path(place).parent.parent for place in places] == [site] * len(PACKAGES)
    words = ("demo", "--headless", "--json", "--seconds", "30", "--speed", "8", "--world", "fast", "--out", "out")
    printed = run(sys.executable, "-m", "sitegrid", *words, folder=tmp_path, PYTHONPATH=str(site))
    assert json.loads(printed.splitlines()[-1])
    assert [*(tmp_path / "out").glob("*.png")]


@pytest.mark.timeout(3000)
@NEEDS_TOOLS
def test_a_wheel_runs_a_demo_with_python_3_13_of_debian_13_and_without_pybullet(wheel: Path, tmp_path: Path) -> None:
    (tmp_path / "given").mkdir()
    for path in (wheel, ROOT / "constraints.txt"):
        shutil.copy(path, tmp_path / "given")
    with Images(tmp_path) as images:
        mounts = (*MOUNTS, "--volume", f"{tmp_path / 'given'}:/given:ro")
        words = ("--isolation", "chroot", *mounts, images.debian("trixie"), "--", "sh", "-ec", IN_DEBIAN_13)
        printed = images.run("run", *words)
    assert printed.startswith("Python 3.13.")
    assert printed.count("the fast world takes the place of PyBullet") == 1
    delivery = re.search(r"merged (\d+), lost 0, double 0", printed)
    assert delivery, printed
    assert int(delivery[1]) > 0


@pytest.mark.parametrize(("python", "machine"), [("3.12", "x86_64"), *((f"3.{n}", "aarch64") for n in (11, 12, 13))])
def test_the_demo_has_a_wheel_of_every_pin_for(python: str, machine: str, tmp_path: Path) -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    texts = [project["dependencies"], *(extras[name] for name in ("agent", "archive", "server", "sim", "web"))]
    target = {"python_version": python, "platform_machine": machine}
    wanted = [one for text in chain(*texts) if not (one := Requirement(text)).name.startswith("sitegrid")]
    names = {str(one).partition(";")[0] for one in wanted if not one.marker or one.marker.evaluate(target)}
    assert not any(name.startswith("pybullet") for name in names)
    tags = [word for minor in GLIBC for word in ("--platform", f"manylinux_2_{minor}_{machine}")]
    words = ("--dry-run", "--ignore-installed", "--only-binary", ":all:", "--python-version", python, *tags)
    pins = ("--constraint", ROOT / "constraints.txt", "--target", tmp_path)
    run(sys.executable, "-m", "pip", "install", "--quiet", *words, *pins, *sorted(names), folder=tmp_path)


def test_a_bill_of_materials_names_all_that_is_installed_with_its_licence() -> None:
    bill = json.loads(run(sys.executable, "-m", "tests.release.bill", folder=ROOT))
    assert bill["bomFormat"] == "CycloneDX"
    parts = {(part["name"].lower(), part["version"]): part["licenses"] for part in bill["components"]}
    assert set(parts) == {(one.metadata["Name"].lower(), one.version) for one in distributions()}
    without = [name for (name, _), licences in parts.items() if not licences]
    assert len(without) < len(parts) / 20, without


def test_a_bundle_installs_without_a_network_and_nothing_else_than_what_it_says(tmp_path: Path) -> None:
    wheels, venv = tmp_path / "wheels", tmp_path / "venv"
    run("make", f"PYTHON={sys.executable}", f"WHEELS={wheels}", "OF=security", "bundle", folder=ROOT)
    run(sys.executable, "-m", "venv", venv, folder=tmp_path)
    install = (venv / "bin" / "pip", "install", "--quiet", "--no-index", "--find-links", wheels, "--require-hashes")
    run(*install, "--requirement", wheels / "requirements.txt", folder=tmp_path)
    assert version() in run(venv / "bin" / "sitegrid", "--version", folder=tmp_path)
    (one,) = wheels.glob("msgpack-*.whl")
    one.write_bytes(one.read_bytes() + b"!")
    with pytest.raises(AssertionError, match="DO NOT MATCH"):
        run(*install, "--force-reinstall", "--requirement", wheels / "requirements.txt", folder=tmp_path)
