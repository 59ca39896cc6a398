"""Agents' runs continued in another store, refolded or accepted by a person."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from mapserver.journal.location import JournalLocation
from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from sitegrid.cli import main
from sitegrid.client import Client
from sitegrid.process.children import Children
from tests.integration.site_run import SiteRun, kill  # beside this file
from tests.patience import until

pytestmark = [pytest.mark.processes, pytest.mark.nightly]
SOME = 20  # samples


@pytest.fixture
def site_run(tmp_path: Path, children: Children) -> SiteRun:
    """Machines driving on long after all are in the map."""
    return SiteRun(
        tmp_path, children, free_endpoint(), SimConfig(machines=2, seconds=120, speed=8, seed=3, world="fast")
    )


def cut_short(site_run: SiteRun) -> str:
    """A site whose server dies after accepting samples; returns its store's id."""
    _, server, _ = site_run.start()
    with site_run.connect() as client:
        until(lambda: len(_samples(client)) == site_run.sim.machines, "every machine has samples there")
        # The next batch follows an acknowledgement, which binds the run to the store.
        first = {name: max(samples, SOME) for name, samples in _samples(client).items()}
        more = "every machine has more of them"
        until(lambda: all(n > first[name] for name, n in _samples(client).items()), more)
    kill(server)
    return JournalLocation(site_run.folder / "store").store_id()


def _samples(client: Client) -> dict[str, int]:
    return {name: counts.samples for name, counts in client.info().machines.items()}


def test_a_run_goes_on_in_a_store_that_was_folded_from_the_first(site_run: SiteRun, capsys: pytest.CaptureFixture[str]):
    first = cut_short(site_run)
    (site_run.folder / "store").rename(site_run.folder / "old")
    paths = (site_run.folder / "old", "--out", site_run.folder / "store", "--site-file", site_run.site_file)
    words = ["fold", *map(str, paths), "--json"]
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["descends"] == [first]
    site_run.start_server()
    reports = site_run.delivered()
    with site_run.connect() as client:
        info = client.info()
    assert sum(counts.lost for counts in info.machines.values()) == 0
    assert sum(counts.samples for counts in info.machines.values()) == sum(r["samples"] for r in reports.values())


def test_a_run_goes_on_in_a_store_that_a_person_accepts_and_what_it_lacks_is_counted(site_run: SiteRun):
    first = cut_short(site_run)
    shutil.move(site_run.folder / "store", site_run.folder / "gone")
    site_run.start_server()
    with site_run.connect() as client:
        until(lambda: client.info().counters.get("refused_other_store", 0) > 0, "a machine is refused")
        assert client.info().machines == {}
        words = ["accept", first, "--reason", "its disk died", "--site", site_run.site, "--endpoint", site_run.endpoint]
        assert main(words) == 0
        reports = site_run.delivered()
        info = client.info()
    recorded = sum(report["samples"] for report in reports.values())
    lost = sum(counts.lost for counts in info.machines.values())
    assert info.accepted == (first,)
    assert lost >= SOME
    assert sum(counts.samples for counts in info.machines.values()) + lost == recorded
