"""The loads of `python -m lab speed`: one law for all, and their tools."""

from __future__ import annotations

import json
import math
from collections import Counter
from itertools import islice

import numpy as np
import pytest

from lab import sums
from lab.speed import filter as filters
from lab.speed import fleet, ingest, merge, query, restart, sim, site, visitors
from lab.speed.__main__ import LOADS, OPTIONS, load_of, main
from lab.speed.measure import in_turn, scattered, track
from protocol.errors import Refusal
from protocol.wire.codec import decode_batch
from protocol.wire.messages import Ack, Refused
from tests.paths import ROOT
from tests.site_work import batches, samples_of, seconds_of, write_store

# Smallest options of each load, and required cases.
SMALLEST = {
    "merge": ("--samples 1000 --runs 1", [f"track, {name}" for name in merge.variants()]),
    "ingest": ("--samples 250 --runs 1", ["SQLite, 6 in a batch, 1 in a commit", "SQLite", "PostgreSQL"]),
    "fleet": ("--machines 8 --seconds 3 --hours 0.02", ["paced", "saturated", "agent"]),
    "live": ("--hours 0.05 --seconds 2", ["writer", "fold", "look", "audit", "snapshot", "sum"]),
    "query": (
        "--hours 0.1 --queries 2",
        ["cold way", "cold as_of", "warm way", "warm as_of"],
    ),
    "visitors": ("--queries 2", [*visitors.questions(), "stays"]),
    "restart": ("--samples 1950 --hours 0.02 --runs 1", ["open, rows of 6", "fold, 2 threads", "grid", "server"]),
    "filter": ("--steps 3 --runs 1", ["stock ukf, predict", "ekf, update rate", "ukf and smoother", "agent"]),
    "sim": ("--seconds 0.5 --runs 2", ["pybullet, 1", "fast, 3"]),
    "archive": ("--samples 20000 --runs 1", ["thread", "threads", "jobs"]),
    "walks": ("--hours 0.01", ["fix", "worklist"]),
    "export": ("--hours 0.05 --runs 1", ["command", "map"]),
    "followers": ("--machines 4 --seconds 2 --hours 0.02 --runs 1", ["alone", "readers", "readers and followers"]),
}
COLUMNS = ["case", "figure", "value", "goal", "met"]


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shrink what has no option."""
    monkeypatch.setattr(sim, "FLEETS", (("paper_site", "pybullet", 1, 1.0), ("busy_site", "fast", 3, 1.0)))
    monkeypatch.setattr(filters, "SMOOTHER_S", 20)
    monkeypatch.setattr(filters, "AGENT_S", 20)
    monkeypatch.setattr(ingest, "BATCHES", (6, 100))
    monkeypatch.setattr(fleet, "SPEED", 20.0)
    monkeypatch.setattr(restart, "TAIL_SAMPLES", 700)
    monkeypatch.setattr(visitors, "KNOWN_M", 128.0)


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.timeout(1800)  # simulated drives, settling servers, busy hosts
@pytest.mark.parametrize("name", LOADS)
def test_every_load_prints_figures_in_the_same_columns(name, small, capsys):
    words, cases = SMALLEST[name]
    assert main([name, "--json", *words.split()]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["load"] == name
    rows = printed["rows"]
    assert all(list(row) == COLUMNS for row in rows)
    assert not set(cases) - {row["case"] for row in rows}
    assert len({(row["case"], row["figure"]) for row in rows}) == len(rows)
    values = [row["value"] for row in rows if row["value"] is not None]
    assert all(math.isfinite(value) for value in values)
    assert sum(value > 0 for value in values) > len(values) / 2
    judgements = {(row["case"], row["figure"]): row["goal"] for row in rows if row["goal"]}
    if name not in ("ingest", "sim"):  # PostgreSQL may be missing; fleets differ here
        assert judgements == dict(load_of(name).GOALS)


@pytest.mark.parametrize("name", LOADS)
def test_an_option_that_does_nothing_for_a_load_or_is_not_positive_is_refused(name, capsys):
    own = load_of(name).OPTIONS
    words = [[f"--{option}", "2"] for option in OPTIONS if option not in own]
    words += [[f"--{option}", value] for option in own for value in ("0", "-1", "many", "nan")]
    for bad in words:
        with pytest.raises(SystemExit) as refusal:
            main([name, *bad])
        assert refusal.value.code == 2
        assert bad[0] in capsys.readouterr().err


def test_variants_take_turns_and_medians_count():
    order = []
    drawn = {"a": iter((3.0, 1.0, 2.0)), "b": iter((9.0, 8.0, 7.0))}

    def variant(name):
        def run():
            order.append(name)
            return {"x": next(drawn[name])}

        return run

    assert in_turn({name: variant(name) for name in drawn}, 3) == {"a": {"x": 2.0}, "b": {"x": 8.0}}
    assert order == ["a", "b"] * 3


@pytest.mark.parametrize("draw", [track, scattered])
def test_both_plain_sums_are_those_of_bincount(draw):
    rows = draw(3000)
    rows["x_m"][1::2], rows["y_m"][1::2] = rows["x_m"][::2], rows["y_m"][::2]  # repeated cells
    cell = np.floor(rows["y_m"]).astype(int) * merge.SIDE + np.floor(rows["x_m"]).astype(int)
    value = rows["c_rr"].astype(float)
    expected = [np.bincount(cell, weights, merge.SIDE**2) for weights in (None, value, value * value)]
    assert expected[0].max() >= 2
    for add in (merge.add_at, merge.add_by_loop):
        total = merge.sums()
        for part in (rows[:1000], rows[1000:]):
            add(total, part)
        np.testing.assert_allclose(total, np.stack(expected, axis=1), rtol=1e-9, atol=1e-15)


def test_a_fold_that_lacks_samples_is_no_measurement(tmp_path, monkeypatch):
    write_store(tmp_path, site.SITE, 20, tail_rows=20)
    assert restart.fold(tmp_path, 2)["samples"] == 2000
    monkeypatch.setattr(restart, "fold_history", lambda *_, **__: True)
    with pytest.raises(RuntimeError, match="0 of 2000 samples are in the grid"):
        restart.fold(tmp_path, 2)


@pytest.mark.slow
def test_no_place_is_asked_for_twice_and_all_are_where_somebody_drove():
    work = list(islice(batches(), 50))
    driven = np.concatenate([rows for _, rows in work])
    asked = query.kinds(work)
    points, regions, past = (list(islice(asked[name], 100)) for name in ("point", "region", "as_of"))
    half = query.REGION_M / 2
    places = [(q.x_m, q.y_m) for q in points + past] + [(q.area.west_m + half, q.area.south_m + half) for q in regions]
    cells = set(map(tuple, np.floor(np.stack([driven["x_m"], driven["y_m"]], axis=1)).tolist()))
    assert len(set(places)) == 300
    assert set(places) <= cells
    assert {q.as_of_ns for q in past} <= set(driven["stamp_ns"].tolist())
    tracks = set(zip(driven["x_m"].tolist(), driven["y_m"].tolist(), strict=True))
    assert all(set(route.line) <= tracks for route in islice(asked["route"], 5))


# --- machines that send ----------------------------------------------------------------------------------------------


class Link:
    """A session that takes batches like a server, refuses some and replies at once."""

    def __init__(self) -> None:
        self.taken: Counter[str] = Counter()
        self.refuse = 0

    def get(self, key: str, handler, payload: bytes, timeout: float) -> None:
        sent = decode_batch(payload, 1e9)
        assert sent.first_seq == self.taken[sent.machine] + 1  # each sample once, in order
        assert (len(sent.rows), key.rsplit("/", 1)[-1]) == (site.SAMPLES, sent.machine)
        self.refuse -= 1
        if self.refuse >= 0:
            self.answers.put((self.number, 0.0, Refused(Refusal.OVERLOADED, "", retry_after_s=0.01)))
            return
        self.taken[sent.machine] += len(sent.rows)
        self.answers.put((self.number, 0.0, Ack(sent.last_seq, 1)))


def test_a_machine_that_was_refused_sends_the_same_again(monkeypatch):
    link, real = Link(), site._ask
    link.refuse = 2

    def ask(one, number, answers) -> None:
        link.number, link.answers = number, answers
        real(one, number, answers)

    monkeypatch.setattr(site, "_ask", ask)
    result = site.send_all(site.fleet([link], 2), 0.05, 0.02)
    assert result.refused == 2
    assert result.samples == sum(link.taken.values()) > 0
    assert len(result.ms) * site.SAMPLES == result.samples


# --- a site's work ---------------------------------------------------------------------------------------------------


def test_work_is_a_function_of_its_seed_and_a_second_has_what_ten_machines_drive_in_it():
    one, same, other = (next(batches(seed))[1] for seed in (1, 1, 2))
    assert one.tobytes() == same.tobytes() != other.tobytes()
    first = next(seconds_of(batches()))
    assert len({name for name, _ in first}) == len(first) == 10
    assert {len(rows) for _, rows in first} == {6}
    assert samples_of(10.0) == 2_160_000


def test_the_page_of_many_sites_has_the_tables_that_follow_from_what_was_measured():
    page = (ROOT / "lab" / "results" / "sums.md").read_text()
    assert [table.splitlines()[0] for table in sums.tables() if table not in page] == []
    small, large = sums.Needs(10, 10), sums.Needs(1000, 500)
    assert (large.sites, large.samples) == (2, pytest.approx(100 * small.samples))
    assert sums.carried(0.5) == sums.carried(1.0) // 2
