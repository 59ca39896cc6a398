"""Structure: small folders, short modules, one-way imports, few options."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT
from tests.structure import CONFIGS, PACKAGES, crowds, is_description, modules, options

MOST_MODULES = 16  # per folder, besides __init__
LIST = Path("sitegrid/commands")  # one module per command, as in `sitegrid --help`
MOST_OPTIONS = 60

# Contracts of pyproject.toml by their first words, each with a violating import and its place.
PLANTED = {
    "Layers: the laboratory": ("sitegrid/proof/delivery.py", "import lab.paper"),
    "An agent never sees": ("agents/pipeline.py", "import sim.state"),
    "An agent is light": ("agents/presence.py", "import cv2"),
    "The client needs": ("sitegrid/client.py", "import mapserver.config"),
    "Layers of the map server": ("mapserver/evidence/cells.py", "import mapserver.journal.rows"),
    "Layers of an agent": ("agents/dead_reckoning.py", "import agents.sampling"),
    "Layers of localisation": ("agents/localisation/filters/ekf.py", "import agents.localisation.gps"),
    "Layers of the simulator": ("sim/state.py", "import sim.simulator"),
    "Layers of the protocol": ("protocol/errors.py", "import protocol.wire.keys"),
    "Layers of the command": ("sitegrid/process/logs.py", "import sitegrid.client"),
    "Layers of the laboratory": ("lab/campaign/workers.py", "import lab.maps.cases"),
    "No import runs in a circle": ("protocol/site/geometry.py", "import protocol.wire.messages"),
}
# Imports forbidden to the functional core, each planted in another part.
CORE = {
    "zenoh": "agents/pipeline.py",
    "sqlite3": "agents/delivery/uplink.py",
    "threading": "mapserver/evidence/pages.py",
    "time": "agents/localisation/filters/ukf.py",
    "pathlib": "mapserver/layers/statistics.py",
    "socket": "mapserver/trust/judgement.py",
    "os": "protocol/errors.py",
}


def linted(folder: Path, planted: dict[str, list[str]]) -> str:
    """Output of lint-imports on a copy of the packages with planted imports."""
    for package in PACKAGES:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__", "*.urdf"))
    shutil.copy(ROOT / "pyproject.toml", folder)
    for name, lines in planted.items():
        path = folder / name
        path.write_text(path.read_text(encoding="utf-8") + "\n".join(["", *lines, ""]), encoding="utf-8")
    command = [str(Path(sys.executable).with_name("lint-imports")), "--no-cache"]
    environment = {"PYTHONPATH": str(folder), "PATH": "", "COLUMNS": "200"}
    return subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False).stdout


@pytest.mark.slow
def test_every_contract_is_broken_by_an_import_that_it_forbids(tmp_path: Path) -> None:
    planted: dict[str, list[str]] = {}
    for path, line in [*PLANTED.values(), *((path, f"import {name}") for name, path in CORE.items())]:
        planted.setdefault(path, []).append(line)
    shown = linted(tmp_path, planted)
    verdicts = dict(re.findall(r"^(\S.*) (KEPT|BROKEN)$", shown, re.MULTILINE))
    assert verdicts, shown
    assert set(verdicts.values()) == {"BROKEN"}, shown
    assert {first for first in PLANTED if any(name.startswith(first) for name in verdicts)} == set(PLANTED)
    assert len(verdicts) == len(PLANTED) + 1
    for name in CORE:
        assert f"is not allowed to import {name}:" in shown, name


def test_no_contract_has_an_exception() -> None:
    assert "ignore_imports" not in (ROOT / "pyproject.toml").read_text(encoding="utf-8")


def test_a_folder_is_taken_in_at_a_glance() -> None:
    crowded = {folder: n for folder, n in crowds(modules(ROOT, *PACKAGES)).items() if n > MOST_MODULES}
    assert not crowded.keys() - {LIST}


def test_options_stay_few() -> None:
    names = {name: [option for option in options(ROOT, name) if not is_description(option)] for name in CONFIGS}
    assert sum(map(len, names.values())) <= MOST_OPTIONS, names
