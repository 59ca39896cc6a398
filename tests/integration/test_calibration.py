"""Corrections of machines through real processes: on request, after accidents, refused, folded elsewhere."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from mapserver.calibration.correction import LAST_NS, Correction, SampleCorrections
from mapserver.calibration.decision import PERSON, SOLVER, CalibrationDecision
from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.store import Store
from mapserver.journal.history import history_rows
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.sqlite.journal import SqliteJournal
from mapserver.journal.sqlite.reader import SqliteReader
from protocol.arrays import Table
from protocol.queries.requests import CalibrationQuery
from protocol.site.site_file import load_site
from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from sim.simulator import START_NS
from sitegrid.process.children import Child, Children
from tests.command_lines import said
from tests.integration.site_run import SiteRun, kill
from tests.integration.test_evidence import Senders
from tests.journals import history_beside
from tests.reference.correction import in_numpy
from tests.unit.mapserver.calibration.drives import LOW, RAMP, RAMP_AGAIN, Errors, drive
from tests.unit.mapserver.data import same

pytestmark = pytest.mark.processes

DRIVES = {
    "a": drive(LOW, Errors(zero=0.008), seed=1, seconds=240),
    "b": drive(RAMP, Errors(zero=-0.006, scale=0.05), seed=2, seconds=240),
    "c": drive(RAMP_AGAIN, Errors(scale=-0.04), seed=3, seconds=240),
}
ASKED = "[store]\narchive_after_h = 0.0\n[calibration]\nautomatic = false\n"  # only requested corrections
ZERO = 0.02


@pytest.fixture
def site(site: SiteRun) -> SiteRun:
    site.start_router()
    return site


def serve(site: SiteRun) -> Child:
    (site.folder / "server.toml").write_text(ASKED)
    return site.start_server("--config", str(site.folder / "server.toml"))


def stored(folder: Path, site: SiteRun) -> closing[Store]:
    return closing(Store(JournalLocation(folder), load_site(site.site_file), ServerConfig(), time.time_ns))


def folded(site: SiteRun, corrections: SampleCorrections, sent: dict[str, Table]) -> Grid:
    """Fold of all samples, corrected in numpy."""
    grid = Grid(load_site(site.site_file).cell_m, ServerConfig().fold)
    for name, rows in sent.items():
        out = rows.copy()
        for one in corrections.each:
            if one.machine == name:
                hit = (rows["stamp_ns"] >= one.from_ns) & (rows["stamp_ns"] < one.to_ns)
                out[hit] = in_numpy(rows[hit], one)
        grid.fold(out, name)
    return grid


def by_person(machine: str) -> SampleCorrections:
    return SampleCorrections([Correction(machine, 0, LAST_NS, ZERO, 0.0, 0.0, ())])


def sample_bytes(journal: Path) -> dict[tuple[str, int], bytes]:
    with SqliteReader(journal) as reader:
        return {(row.machine, row.first_seq): row.rows.tobytes() for row in history_rows(history_beside(reader))}


def test_asked_for_the_map_is_that_of_a_first_fold_everywhere(site: SiteRun):
    server, folder = serve(site), site.folder
    with site.connect() as client:
        client.info(after=Senders(site, client).send(DRIVES))
        before = client.region((0, 0, 120, 60), ("resistance",))
        answer = said("calibrate", "--endpoint", site.endpoint, "--site", site.site, "--json").json
        assert [row["by"] for row in answer["machines"]] == ["solver"] * 3
        assert answer["machines"][0]["zero"] == pytest.approx(0.008, abs=0.003)
        info = client.info()
        assert (info.fact, info.decided, info.corrections >= 3) == (answer["fact"], answer["fact"], True)
        after = client.region((0, 0, 120, 60), ("resistance",))
        assert after.version.fact == answer["fact"]
        assert not np.array_equal(before["resistance"], after["resistance"], equal_nan=True)
        then = client.region((0, 0, 120, 60), ("resistance",), as_of=info.stamp_ns)
        assert np.array_equal(then["resistance"], after["resistance"], equal_nan=True), "the past has the facts of now"
        assert then.version.fact == answer["fact"]
    server.stop()
    with stored(folder / "store", site) as store:
        corrections, live = store.facts.corrections, store.grid
    assert same(live, folded(site, corrections, DRIVES))
    again = said("fold", folder / "store", "--site-file", site.site_file, "--out", folder / "again", "--json")
    assert again.code == 0, again.err
    assert sample_bytes(folder / "again" / JOURNAL_FILE) == sample_bytes(folder / "store" / JOURNAL_FILE)
    with stored(folder / "again", site) as store:
        assert same(store.grid, live)
        assert store.facts.corrections == corrections


def killed_with_a_fact_on_disk(site: SiteRun, server: Child) -> None:
    """Kill a server right after storing a decision, around its fold."""
    with site.connect() as client:
        try:
            client.correct("a", "levelled", zero=ZERO, wait_s=0.0)
        except Exception as error:  # the decision is stored, but not folded yet
            assert "the decision is kept" in str(error)  # noqa: PT017
    kill(server)


def with_an_old_snapshot(site: SiteRun, server: Child) -> None:
    """Stop a server, decide, and restore its earlier snapshot."""
    server.stop()
    old = next(iter((site.folder / "store").glob("snapshot-*")))
    kept = old.read_bytes()
    server = serve(site)
    with site.connect() as client:
        client.correct("a", "levelled", zero=ZERO)
    kill(server)
    for path in (site.folder / "store").glob("snapshot-*"):
        path.unlink()
    old.write_bytes(kept)


@pytest.mark.nightly
@pytest.mark.parametrize("accident", [killed_with_a_fact_on_disk, with_an_old_snapshot])
def test_after_an_accident_the_next_start_has_the_fact_in_its_map(
    site: SiteRun, accident: Callable[[SiteRun, Child], None]
):
    server = serve(site)
    with site.connect() as client:
        client.info(after=Senders(site, client).send(DRIVES))
    accident(site, server)
    server = serve(site)
    with site.connect() as client:
        info = client.info()
        assert (info.fact, info.decided, info.corrections) == (1, 1, 1)
        assert client.ask(CalibrationQuery()).machines[0].by == PERSON
    server.stop()
    with stored(site.folder / "store", site) as store:
        assert same(store.grid, folded(site, by_person("a"), DRIVES))


@pytest.mark.nightly
def test_an_agent_that_accepts_offers_takes_the_server_s_and_states_it(tmp_path: Path, children: Children):
    """Offered with the samples' first acknowledgement; applied at standstill or a tour's end."""
    sim = SimConfig(machines=2, seconds=160, speed=10, seed=3, world="fast")
    site = SiteRun(tmp_path, children, free_endpoint(), sim)
    one, other = (config.stem for config in site.configs)
    with site.configs[0].open("a", encoding="utf-8") as text:
        text.write("[pipeline.estimation]\naccept_calibration = true\n")
    site.start_router()
    serve(site).stop()
    config, path = load_site(site.site_file), tmp_path / "store" / JOURNAL_FILE
    covariance = ((4e-7, 0.0, 0.0), (0.0, 2e-5, 0.0), (0.0, 0.0, 1e-6))
    with closing(SqliteJournal(path, config.name, config.frame)) as journal:
        for name in (one, other):
            offered = Correction(name, START_NS, LAST_NS, 0.004, 0.03, 0.0, covariance)
            decision = CalibrationDecision(name, SOLVER, "", START_NS, (offered,))
            journal.append_event("calibration", START_NS, decision.body())
    server = serve(site)
    site.start_agents()
    site.start_sim()
    calibrations = {name: report["pipeline"]["ground"]["calibration"] for name, report in site.delivered().items()}
    assert (calibrations[one]["offers"], calibrations[one]["offer_ns"]) == (1, START_NS)
    assert "offers" not in calibrations[other]
    server.stop()
    with SqliteReader(path) as reader:
        stated = {
            name: np.concatenate([row.rows["applied_scale"] for row in reader.read() if row.machine == name])
            for name in (one, other)
        }
    assert np.abs(stated[one] - 0.03).min() < 0.015
    assert np.abs(stated[other] - 0.03).min() > 0.015
