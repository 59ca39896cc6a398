"""The keeper on a real writer and store: decisions fold machines out and in, changes are told, old rows move away."""

import threading
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from mapserver.config import KeepConfig, ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.follower.follower import Keeper
from mapserver.ingest.writer import Writer
from mapserver.journal.archive import FOLDER
from mapserver.trust.auditor import TrustConfig
from protocol.errors import QueryError
from protocol.site.ground_classes import ZONES
from tests.unit.mapserver.data import NOW_NS, SITE, incoming, now_ns, random_samples, same, samples, send, wait_for

QUICK: dict[str, Any] = {"turn_s": 0.01, "judge_s": 0.02, "archive_after_h": 0.0}
HOUR_NS = 3600 * 10**9


class Site:
    """A writer with its keeper over a folder, and what was published."""

    def __init__(self, folder, now=now_ns, **keep: Any) -> None:
        self.told: list[dict[str, Any]] = []
        self.config = ServerConfig(keep=KeepConfig(**(QUICK | keep)), trust=TrustConfig(min_cells=20))
        self.writer = Writer(folder, SITE, self.config, now)
        self.keeper = Keeper(self.writer, folder, SITE, self.config, self.told.append, now)

    @property
    def grid(self) -> Grid:
        return self.writer.read(lambda store: store.grid)

    def machine(self, name: str) -> dict[str, Any]:
        return next(row for row in self.keeper.machines() if row["name"] == name)

    def close(self) -> None:
        self.keeper.close()
        self.writer.close()


@pytest.fixture
def opened(tmp_path):
    sites: list[Site] = []

    @contextmanager
    def open_site(**options: Any):
        sites.append(Site(tmp_path / "store", **options))
        try:
            yield sites[-1]
        finally:
            sites.pop().close()

    yield open_site
    for site in sites:
        site.close()


def fleet(bad: dict[str, float], passes: int = 2, size: int = 48) -> dict[str, list[Any]]:
    """Four machines that sweep the same three zones; those in `bad` report c_rr times a gain."""
    zone = np.array([ZONES[i].c_rr for i in (0, 2, 3)])
    sent: dict[str, list[Any]] = {}
    for i, name in enumerate("abcd"):
        draw = np.random.default_rng(i)
        x, y = (v.ravel() + 0.5 for v in np.meshgrid(np.arange(size), np.arange(size)))
        sent[name] = []
        for number in range(passes):
            place = x + draw.normal(0, 0.3, len(x)), y + draw.normal(0, 0.3, len(x))
            c_rr = zone[(x * 3 // size).astype(int)] * bad.get(name, 1.0) * draw.normal(1, 0.03, len(x))
            stamps = NOW_NS + number * 3 * HOUR_NS + np.arange(len(x)) * 10**8
            values = {"x_m": place[0], "y_m": place[1], "c_rr": c_rr, "stamp_ns": stamps, "cov_xx_m2": 0.09}
            sent[name].append(samples(len(x), **values, cov_yy_m2=0.09))
    return sent


def deliver(site: Site, sent: dict[str, list[Any]]) -> None:
    """Batches of all machines in turn, as they come in."""
    seq = dict.fromkeys(sent, 1)
    parts = {name: np.array_split(np.concatenate(rows), 20) for name, rows in sent.items()}
    for i in range(20):
        for name, mine in parts.items():
            send(site.writer, [incoming(mine[i], seq[name], name)])
            seq[name] += len(mine[i])


def fold_of(sent: dict[str, list[Any]], config: ServerConfig, without: str = "") -> Grid:
    grid = Grid(SITE.cell_m, config.fold)
    for name, rows in sent.items():
        if name not in without:
            for part in rows:
                grid.fold(part, name)
    return grid


def test_a_distrusted_machine_is_folded_out_and_in_again_to_the_bit(opened):
    sent = fleet({})
    with opened(distrusts=False) as site:
        deliver(site, sent)
        row = site.keeper.trust("b", False, "its scale is broken", 20.0)
        assert (row["trusted"], row["by"], row["reason"]) == (False, "person", "its scale is broken")
        assert same(site.grid, fold_of(sent, site.config, without="b"))
        assert site.keeper.distrusted() == {"b"}
        assert site.keeper.trust("b", True, "repaired", 20.0)["trusted"]
        assert same(site.grid, fold_of(sent, site.config))


def test_rows_of_a_distrusted_machine_are_kept_and_stay_out(opened):
    sent = fleet({})
    with opened(distrusts=False) as site:
        for name in sent:
            send(site.writer, [incoming(sent[name][0], 1, name)])
        site.keeper.trust("b", False, "", 20.0)
        for name in sent:
            send(site.writer, [incoming(sent[name][1], 1 + len(sent[name][0]), name)])
        assert same(site.grid, fold_of(sent, site.config, without="b"))
        assert site.machine("b")["samples"] == sum(map(len, sent["b"]))
        site.keeper.trust("b", True, "", 20.0)
        assert same(site.grid, fold_of(sent, site.config))


@pytest.mark.parametrize("snapshot", [True, False])
def test_a_decision_outlives_the_server(opened, tmp_path, snapshot):
    sent = fleet({})
    with opened(distrusts=False) as site:
        deliver(site, sent)
        site.keeper.trust("b", False, "why", 20.0)
    if not snapshot:
        for path in (tmp_path / "store").glob("snapshot-*"):
            path.unlink()
    with opened(distrusts=False) as site:
        assert same(site.grid, fold_of(sent, site.config, without="b"))
        assert (site.machine("b")["trusted"], site.machine("b")["reason"]) == (False, "why")


def test_a_machine_that_contradicts_all_others_is_found_and_left_out(opened):
    sent = fleet({"c": 1.6})
    with opened() as site:
        deliver(site, sent)
        wait_for(lambda: site.keeper.distrusted() == {"c"})
        row = site.machine("c")
        assert (row["trusted"], row["by"]) == (False, "audit")
        assert "gain" in row["reason"]
        assert row["evidence"]["gain"] == pytest.approx(1.6, rel=0.15)
        wait_for(lambda: same(site.grid, fold_of(sent, site.config, without="c")))
        assert all(site.machine(name)["trusted"] for name in "abd")


def test_a_bad_machine_is_only_named_where_the_server_may_not_distrust(opened):
    with opened(distrusts=False) as site:
        deliver(site, fleet({"c": 1.6}))
        wait_for(lambda: site.machine("c")["contradicts"])
        never = threading.Event()
        for _ in range(10):  # turns in which it could be left out
            never.wait(QUICK["judge_s"])
        assert site.keeper.distrusted() == frozenset()
        assert site.machine("c")["trusted"]
        assert site.machine("c")["reasons"]


def test_a_person_overrules_the_audit_and_hands_back(opened):
    with opened() as site:
        deliver(site, fleet({"c": 1.6}))
        wait_for(lambda: site.keeper.distrusted() == {"c"})
        assert site.keeper.trust("c", True, "I know better", 20.0)["by"] == "person"
        assert site.keeper.distrusted() == frozenset()
        assert not site.keeper.trust("c", None, "", 20.0)["trusted"]
        assert site.keeper.distrusted() == {"c"}


def test_a_machine_that_sent_nothing_is_refused_by_name(opened):
    with opened() as site:
        send(site.writer, [incoming(samples(3), machine="a")])
        with pytest.raises(QueryError, match="`nobody` has sent nothing; known: a"):
            site.keeper.trust("nobody", False, "", 1.0)


def repaved(site: Site) -> None:
    size = 40
    x, y = (v.ravel() + 0.5 for v in np.meshgrid(np.arange(size), np.arange(size)))
    first = 1
    for hour, c_rr in ((0, 0.06), (1, 0.06), (2, 0.02)):
        stamps = NOW_NS + hour * HOUR_NS + np.arange(len(x)) * 10**8
        rows = samples(len(x), x_m=x, y_m=y, c_rr=c_rr, stamp_ns=stamps, cov_xx_m2=0.25)
        send(site.writer, [incoming(rows, first)])
        first += len(rows)


def test_a_change_is_told_listed_and_remembered(opened):
    with opened() as site:
        repaved(site)
        wait_for(lambda: site.told)
        wait_for(lambda: site.keeper.changes() and site.keeper.changes()[0]["cells"] > 1000)
        (change,) = site.keeper.changes()
        assert site.told[-1] == change
        assert change["resistance_after"] == pytest.approx(0.02, rel=0.05)
    with opened() as site:
        assert site.keeper.changes() == [change]
        wait_for(lambda: not site.writer.read(lambda store: store.grid.take_touched(1)))
        assert site.told == []
        assert site.keeper.changes(after=change["id"]) == []


@pytest.mark.parametrize("hours", [0.0, 1.0])
def test_old_rows_move_to_the_archive_and_the_map_stays(opened, tmp_path, hours):
    rows = random_samples(400, 3)
    later = [NOW_NS]
    with opened(now=lambda: later[0], archive_after_h=hours) as site:
        for first in range(0, 400, 100):
            send(site.writer, [incoming(rows[first : first + 100], first + 1)])
        later[0] += 3 * HOUR_NS
        send(site.writer, [incoming(samples(5), 401)])
        site.keeper._due_s["archive"] = 0.0
        if hours:
            wait_for(lambda: site.writer.read(lambda store: store._journal.archived_row) == 4)
        before = site.grid.state()
        site.keeper.trust("a", False, "", 20.0)
        site.keeper.trust("a", True, "", 20.0)  # folded from archive and journal
        assert [p.page.votes.tobytes() for p in site.grid.state().pages] == [
            p.page.votes.tobytes() for p in before.pages
        ]
    files = list((tmp_path / "store" / FOLDER).glob("*.parquet"))
    assert bool(files) == bool(hours)
    for path in (tmp_path / "store").glob("snapshot-*"):
        path.unlink()
    with opened(archive_after_h=hours) as site:
        assert site.grid.state().folded == before.folded


def test_a_damaged_archive_is_named_and_the_server_goes_on(opened, tmp_path, caplog):
    later = [NOW_NS]
    with opened(now=lambda: later[0], archive_after_h=1.0) as site:
        send(site.writer, [incoming(samples(5))])
        later[0] += 3 * HOUR_NS
        site.keeper._due_s["archive"] = 0.0
        wait_for(lambda: site.writer.read(lambda store: store._journal.archived_row) == 1)
        (path,) = (tmp_path / "store" / FOLDER).glob("*.parquet")
        path.write_bytes(path.read_bytes()[:-50])
        with pytest.raises(QueryError, match="not folded again"):
            site.keeper.trust("a", False, "", 0.5)
        assert path.name in caplog.text
        send(site.writer, [incoming(samples(5), 6)])
        assert site.grid.state().folded == 10
