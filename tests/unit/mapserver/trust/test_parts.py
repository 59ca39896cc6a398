"""The parts of trust: maps that depend on no order, votes, clocks, shifts, options."""

import tracemalloc
from collections.abc import Iterator

import numpy as np
import pytest

from mapserver.trust.auditor import Auditor, TrustConfig
from mapserver.trust.clock import ClockWatch
from mapserver.trust.coarse_map import LEVEL_FLOOR, Ledger, Surface, map_cell_m, pooled
from mapserver.trust.machine_vote import AGREE, DISAGREE, UNKNOWN, outvoted
from protocol.arrays import Ints, Table
from tests.unit.mapserver.data import NOW_NS, random_samples, samples

PERIOD_NS = 300 * 10**9
MB = 1e6


def ledger(parts: list[Table], periods: int = 3) -> Surface:
    made = Ledger(1.0, PERIOD_NS, periods)
    for part in parts:
        made.add(part)
    return made.surface()


def same(one: Surface, other: Surface) -> bool:
    return (
        bool(np.array_equal(one.codes, other.codes) and np.array_equal(one.sums, other.sums))
        and one.std_m == other.std_m
    )


@pytest.mark.parametrize("seed", range(5))
def test_any_order_and_any_batching_give_the_same_bits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = random_samples(20_000, seed)
    mixed = np.array_split(rng.permutation(rows), np.sort(rng.integers(0, len(rows), 60)))
    assert same(ledger([rows]), ledger(mixed))


def test_a_cell_keeps_its_metres_and_its_mean_level() -> None:
    surface = ledger([samples(2, c_rr=[0.02, 0.04], distance_m=[1.0, 3.0])])
    assert surface.metres.tolist() == [4.0]
    expected = (np.log(0.02 + LEVEL_FLOOR) + 3 * np.log(0.04 + LEVEL_FLOOR)) / 4
    assert surface.level == pytest.approx([expected], abs=1e-3)
    assert surface.std_m == pytest.approx(0.1, abs=0.01)


def test_rows_without_resistance_or_distance_are_not_entered() -> None:
    assert len(ledger([samples(2, c_rr=[np.nan, 0.04], distance_m=[1.0, 0.0])]).codes) == 0


def test_only_the_newest_periods_are_remembered() -> None:
    rows = samples(5, stamp_ns=NOW_NS + np.array([9, 0, 1, 2, 0]) * PERIOD_NS)
    assert len(ledger([rows]).codes) == 3
    assert same(ledger([rows], periods=1), ledger([rows[:1]], periods=1))


def test_a_pooled_map_without_one_of_its_parts_is_the_map_of_the_rest() -> None:
    one, other = ledger([random_samples(500, 1)]), ledger([random_samples(500, 2)])
    rest = pooled([one, other]).without(one)
    assert np.array_equal(rest.codes, other.codes)
    assert np.array_equal(rest.sums, other.sums)
    assert len(pooled([]).codes) == 0


@pytest.mark.parametrize(("cell_m", "expected"), [(1.0, 2.0), (0.5, 2.0), (0.7, 2.1), (5.0, 5.0)])
def test_cells_are_whole_cells_of_the_site(cell_m: float, expected: float) -> None:
    assert map_cell_m(cell_m) == pytest.approx(expected)


def test_ten_machines_on_a_large_site_take_little_memory() -> None:
    """1 km2, 10 % of it driven by each of ten machines: 25 000 cells of 2 m."""
    x_m, y_m = np.meshgrid(np.arange(0.5, 1000, 2), np.arange(0.5, 100, 2))
    rows = samples(x_m.size, x_m=x_m.ravel(), y_m=y_m.ravel(), stamp_ns=NOW_NS)
    tracemalloc.start()
    auditor = Auditor(TrustConfig(), 1.0)
    for machine in "abcdefghij":
        auditor.add(machine, rows)
        auditor.add(machine, rows)
    used = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert auditor.nbytes <= used < 30 * MB


def test_an_auditor_that_heard_nothing_has_no_verdicts() -> None:
    auditor = Auditor(TrustConfig(), 1.0)
    auditor.add("a", samples(0))
    assert auditor.verdicts() == {}


def states(n: int, *against: tuple[int, int], unknown: tuple[tuple[int, int], ...] = ()) -> Ints:
    matrix = np.full((n, n), AGREE)
    np.fill_diagonal(matrix, UNKNOWN)
    for value, pairs in ((DISAGREE, against), (UNKNOWN, unknown)):
        for one, other in pairs:
            matrix[one, other] = matrix[other, one] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (states(2, (0, 1)), [(), ()]),
        (states(3, (0, 2), (1, 2)), [(), (), (0, 1)]),
        (states(3, (0, 1), (0, 2), (1, 2)), [(), (), ()]),
        (states(3, (0, 2), (1, 2), unknown=((0, 1),)), [(), (), ()]),
        (states(4, (0, 2), (0, 3), (1, 2), (1, 3)), [(), (), (), ()]),
        (states(4, (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)), [(), (), (0, 1), (0, 1)]),
        (states(5, *((i, j) for i in (3, 4) for j in range(3))), [(), (), (), (0, 1, 2), (0, 1, 2)]),
        (states(5, *((i, j) for i in (2, 3, 4) for j in range(i))), [()] * 5),
    ],
    ids=["two", "one of three", "each of three", "strangers", "two to two", "two alone", "two alike of five", "most"],
)
def test_the_larger_side_that_agrees_in_itself_outvotes(matrix: Ints, expected: list[tuple[int, ...]]) -> None:
    assert outvoted(matrix) == expected


def judged(sent: Iterator[tuple[str, float]], steady_s: float = 60.0) -> int:
    """State of machine x against o after these (machine, newest stamp [s]) in order of arrival."""
    watch = ClockWatch(span_s=600, steady_s=steady_s, limit_s=300)
    for machine, stamp_s in sent:
        watch.add(machine, round(stamp_s * 1e9))
    return watch.compare("x", "o")[1].state


def both(
    pace: float = 1.0, late_s: float = 0.0, jitter_s: float = 0.0, others_stop_s: float = 1e9
) -> Iterator[tuple[str, float]]:
    """Every 10 s of the others' time each sends once; x is late and sends at its own pace, as it can."""
    rng = np.random.default_rng(0)
    for now in range(10_000, 13_000, 10):
        yield "o", min(now, others_stop_s)
        yield "x", min(now, 10_000 + (now - 10_000) * pace - late_s + jitter_s * rng.random())


@pytest.mark.parametrize(
    ("case", "state"),
    [
        ({}, AGREE),
        ({"jitter_s": -200.0}, AGREE),
        ({"late_s": 3600.0}, DISAGREE),
        ({"late_s": 3600.0, "jitter_s": 40.0}, DISAGREE),
        ({"late_s": 3600.0, "jitter_s": 80.0}, UNKNOWN),
        ({"late_s": 86_400.0, "pace": 1.2}, UNKNOWN),
        ({"late_s": 86_400.0, "pace": 20.0}, UNKNOWN),
        ({"others_stop_s": 11_000.0}, UNKNOWN),
    ],
)
def test_only_a_steady_lead_is_a_wrong_clock(case: dict[str, float], state: int) -> None:
    assert judged(both(**case)) == state


def test_how_steady_a_lead_must_be_is_an_option() -> None:
    assert judged(both(late_s=3600.0, jitter_s=40.0), steady_s=5.0) == UNKNOWN


def test_a_machine_that_has_caught_up_agrees() -> None:
    assert judged(both(late_s=1000.0, pace=2.0)) == AGREE


@pytest.mark.parametrize("name", list(TrustConfig.__dataclass_fields__))
def test_every_option_is_refused_by_name_where_it_makes_no_sense(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        TrustConfig(**{name: 0})


@pytest.mark.parametrize(
    ("name", "value"),
    [("gain_limit", 1.0), ("share", 1.0), ("agreement", 1.5), ("stuck_spread", 1.0), ("clock_steady_s", 300.0)],
)
def test_options_out_of_range_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        TrustConfig(**{name: value})
