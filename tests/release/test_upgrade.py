"""From 0.2.0 on, each version opens the stores and spools of all releases before it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from sitegrid.process.children import Children
from tests.paths import ROOT
from tests.patience import PATIENCE_S, until
from tests.release.stores import MACHINES, X_M, Y_M, served, version

pytestmark = [pytest.mark.processes, pytest.mark.nightly]
RELEASES = sorted(path.parent for path in Path(__file__).parent.glob("*/expected.json"))


def test_this_version_has_a_store() -> None:
    assert version() in [path.name for path in RELEASES], "python -m tests.release makes it"


@pytest.mark.parametrize("release", RELEASES, ids=lambda path: path.name)
def test_a_release_s_store_has_its_map_and_its_spool_is_delivered(release: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(release, tmp_path / "release")
    expected = json.loads((folder / "expected.json").read_text())
    with Children(tmp_path) as children, served(folder, children) as (client, place):
        until(lambda: client.info().samples_merged == expected["merged"], "the map without whom it excludes")
        assert client.info().distrusted == (MACHINES[1],)
        values = client.point(X_M, Y_M).values
        assert {name: values[name] for name in expected["values"]} == expected["values"], "bit for bit"
        files = ("--config", ROOT / "config" / "agent.toml", "--spool", folder / "spool.db")
        agent = children.start("agent", "agent", *place, *files, "--name", MACHINES[0])
        until(lambda: client.info().samples_merged == expected["after"], "samples of the spool")
        agent.expect("ready", PATIENCE_S)
        assert agent.stop() == 0
