"""Known errors in drives: found where observable, else not."""

from __future__ import annotations

import tracemalloc
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest

from mapserver.calibration.calibrate import (
    MOST_EPOCHS,
    MOST_MACHINES,
    Solution,
    calibrate,
    epochs_of_each,
    groups,
    joined,
)
from mapserver.calibration.correction import ANY_SHARE, LAST_NS, Correction, corrected
from mapserver.calibration.decide import differs
from mapserver.calibration.ledger import EPOCH_NS, EPOCHS, newest
from mapserver.calibration.passages import passages
from mapserver.calibration.select import FAULT_SIGMAS, MachineErrors, state_of
from mapserver.calibration.solver import known_cells
from protocol.arrays import Floats, Table
from protocol.machine.samples import SCALE_STD, ZERO_STD
from protocol.site.site_config import KnownGround
from tests.unit.mapserver.calibration.drives import (
    FOOT_M,
    LOW,
    OPEN,
    RAMP,
    RAMP_AGAIN,
    START_NS,
    TOP_M,
    Errors,
    Site,
    drive,
    height_slope,
    ledgers,
    soils,
)

FLEET = {
    "low": (LOW, Errors(0.004, -0.05, 0.002)),
    "ramp": (RAMP, Errors(-0.006, 0.04, -0.003)),
    "again": (RAMP_AGAIN, Errors(0.008, 0.03, 0.0)),
}


def fleet(site: Site = soils, errors: Mapping[str, Errors] | None = None) -> dict[str, Table]:
    """Three machines that never reverse."""
    known = errors or {}
    return {
        name: drive(route, known.get(name, own), site=site, seed=i)
        for i, (name, (route, own)) in enumerate(FLEET.items())
    }


def solve(rows: Mapping[str, Table], excluded: tuple[str, ...] = (), **more: object) -> Solution:
    return calibrate(ledgers(rows), excluded, **more)  # type: ignore[arg-type]


@cache
def usual() -> Solution:
    """The unchanged fleet."""
    return solve(fleet())


def check(state: MachineErrors, errors: Errors, zero: float = 0.0016, scale: float = 0.02) -> None:
    assert state.zero == pytest.approx(errors.zero, abs=zero)
    assert state.scale == pytest.approx(errors.scale, abs=scale)


def concrete(x_m: Floats, _: Floats, __: Floats) -> Floats:
    return np.full(len(x_m), 0.008)


def on_ramp(x_m: Floats) -> Floats:
    return (height_slope(x_m) > 0).astype(np.float64)


def test_a_fleet_that_never_reverses_knows_zeros_and_scales() -> None:
    result = usual()
    for name in ("ramp", "again"):
        check(result.machines[name], FLEET[name][1])
        assert result.machines[name].scale_by == ("edges",)
        assert "heights" in result.machines[name].zero_by
        assert result.machines[name].across == pytest.approx(FLEET[name][1].across, abs=0.0025)
    check(result.machines["low"], FLEET["low"][1], scale=0.04)
    assert result.common.observed
    off = [(s.zero - FLEET[n][1].zero) / s.zero_std for n, s in result.machines.items()]
    off += [(s.scale - FLEET[n][1].scale) / s.scale_std for n, s in result.machines.items()]
    assert np.mean(np.square(off)) < 2.5, "what is stated is what is off"


@pytest.mark.parametrize(("direction", "zero"), [(1.0, 0.006), (-1.0, -0.006)])
def test_the_zero_has_its_sign_ahead_and_in_reverse(direction: float, zero: float) -> None:
    rows = drive(LOW, Errors(zero), direction=direction)
    result = solve({"low": rows})
    assert result.machines["low"].zero == pytest.approx(zero, abs=0.0015)
    assert result.machines["low"].zero_std < ZERO_STD / 3
    right = corrected(rows, result.corrections)
    true = drive(LOW, Errors(), direction=direction)
    usual = true["c_rr"] < 0.1  # on sand the scale counts too
    assert abs(np.mean((right["c_rr"] - true["c_rr"])[usual])) < 0.0015


@pytest.mark.parametrize("scale", [0.1, -0.1])
def test_reversing_shows_the_zero_and_on_a_slope_the_scale_by_the_same_ground(scale: float) -> None:
    errors = Errors(0.003, scale)
    there = drive(RAMP, errors, seconds=300.0)
    back = drive(tuple(reversed(RAMP)), errors, seconds=300.0, seed=1, direction=-1, start_s=300.0)
    state = solve({"a": np.concatenate([there, back])}).machines["a"]
    assert "same_ground" in state.scale_by
    assert "same_ground" in state.zero_by
    check(state, errors, zero=0.001, scale=0.015)


def test_a_track_that_nobody_closes_stays_at_the_data_sheet() -> None:
    result = solve({"a": drive(OPEN, Errors(0.006, 0.05), seconds=200.0, closed=False)})
    state = result.machines["a"]
    assert (state.zero, state.scale, state.across) == pytest.approx((0, 0, 0), abs=1e-6)
    assert (state.zero_by, state.scale_by) == ((), ())
    assert state.zero_std == pytest.approx(ZERO_STD, rel=0.05)
    assert state.scale_std == pytest.approx(SCALE_STD, rel=0.05)
    assert not result.common.observed


def test_a_fleet_that_is_off_by_the_same_is_put_right() -> None:
    errors = {name: replace(own, zero=own.zero + 0.015) for name, (_, own) in FLEET.items()}
    result = solve(fleet(errors=errors))
    for name in FLEET:
        check(result.machines[name], errors[name], zero=0.002, scale=0.05)


def test_without_slopes_nothing_pulls_on_the_scale() -> None:
    """Nor do priors for small c_rr or smooth ground: on sand they would resemble a scale."""
    rows = {"a": drive(LOW, Errors(scale=0.08)), "b": drive(LOW, Errors(scale=0.08), seed=1)}
    result = solve(rows)
    assert result.common.std == pytest.approx(SCALE_STD)
    for state in result.machines.values():
        assert state.scale == pytest.approx(0.0, abs=0.01)


def test_noise_of_a_machine_is_not_explained_by_its_scale() -> None:
    """The force share is of the common ground: with the sample's own, noise would seem a scale."""
    rows = fleet()
    draw = np.random.default_rng(5)
    for table in rows.values():
        blocks = np.repeat(draw.normal(0.0, 0.02, len(table) // 4 + 1), 4)[: len(table)]
        table["c_rr"] += blocks
    result = solve(rows)
    for name in ("ramp", "again"):
        assert result.machines[name].scale == pytest.approx(FLEET[name][1].scale, abs=0.035)


def test_a_gain_far_beyond_the_data_sheet_is_seen_and_spoils_no_other() -> None:
    rows = fleet(errors={"again": Errors(0.002, 0.6)})
    result = solve(rows)
    assert result.machines["again"].scale == pytest.approx(0.6, abs=0.04)
    assert result.machines["again"].beyond[1] > 10
    check(result.machines["ramp"], FLEET["ramp"][1], scale=0.025)
    own = [each for each in result.corrections if each.machine == "again"]
    assert own[0].scale == pytest.approx(0.6 / 1.6, abs=0.02)  # k / (1 + k): the measured share includes the gain
    right = corrected(rows["again"], own)
    true = drive(RAMP_AGAIN, Errors(), seed=2)
    assert abs(np.median(right["c_rr"] - true["c_rr"])) < 0.003
    for name in ("again", "ramp"):
        newest_of = [each for each in result.corrections if each.machine == name][-1]
        said, known = state_of(newest_of), result.machines[name]
        assert (said.zero, said.scale, said.across) == pytest.approx((known.zero, known.scale, known.across), abs=5e-5)
        assert (said.zero_std, said.scale_std) == pytest.approx((known.zero_std, known.scale_std), rel=1e-3)
        assert (said.beyond[1] > FAULT_SIGMAS[1]) == (name == "again"), "a correction says what the solve said"


def test_edges_wait_until_the_estimate_has_followed() -> None:
    """Near a bend the c_rr estimate still lags, and the scale would seem too small."""
    errors = {"ramp": Errors(scale=0.12), "again": Errors(scale=0.12)}
    result = solve(fleet(errors=errors))
    mean = np.mean([result.machines[name].scale for name in errors])
    assert mean == pytest.approx(0.12, abs=0.012)


def test_a_rise_across_withheld_samples_is_not_believed() -> None:
    """Rounded foot and top: without samples there, trapezoids show different rises up and down."""
    rows = drive(RAMP, Errors(), seed=4)
    x = rows["x_m"]
    up = rows["y_m"] < 25
    rows = rows[~(up & ((np.abs(x - FOOT_M - 3) < 6) | (np.abs(x - TOP_M + 3) < 2.5)))]
    state = solve({"ramp": rows}).machines["ramp"]
    assert abs(state.zero) < 0.003
    assert abs(state.zero) < 3 * state.zero_std


def test_a_step_of_the_zero_is_followed_from_epoch_to_epoch() -> None:
    errors = {"ramp": Errors(0.002, 0.04, step=0.015, step_s=300.0)}
    result = solve(fleet(errors=errors))
    own = [each for each in result.corrections if each.machine == "ramp"]
    start = START_NS - START_NS % EPOCH_NS
    early = [each.zero for each in own if each.to_ns <= start + EPOCH_NS]
    late = [each.zero for each in own if each.from_ns >= START_NS + 300 * 10**9]
    assert early[0] == pytest.approx(0.002, abs=0.003)
    assert late[-1] == pytest.approx(0.017, abs=0.003)
    check(result.machines["again"], FLEET["again"][1], zero=0.002, scale=0.025)


def test_an_epoch_in_which_the_zero_steps_states_a_large_deviation() -> None:
    stepped, still = (
        solve({"a": drive(LOW, Errors(step=step, step_s=450.0), seconds=900.0)}).corrections for step in (0.015, 0.0)
    )
    assert np.sqrt(stepped[1].covariance[0][0]) == pytest.approx(0.004, abs=0.001)
    assert max(np.sqrt(each.covariance[0][0]) for each in still) < 0.0015


def test_a_ramp_that_is_only_ever_climbed_shows_no_scale() -> None:
    rows = drive(RAMP, Errors(scale=0.1))
    climbed = rows[rows["y_m"] < 25.0]
    result = solve({"a": climbed})
    assert not result.common.observed
    assert result.common.reason == "no_slope_both_ways"


def test_one_ramp_driven_both_ways_in_one_lane_shows_the_scale_by_itself() -> None:
    site: Site = lambda x, y, h: soils(x, y, h) + 0.02 * on_ramp(x)  # noqa: E731
    back = tuple(reversed(RAMP))
    rows = {"a": drive(RAMP, Errors(0.002, 0.08), site=site), "b": drive(back, Errors(0.0, -0.03), site=site, seed=1)}
    result = solve(rows)
    assert result.machines["a"].scale == pytest.approx(0.08, abs=0.02)
    assert result.machines["b"].scale == pytest.approx(-0.03, abs=0.02)
    assert result.machines["a"].scale_by == ("same_ground",)
    assert {each.most_share for each in result.corrections} == {ANY_SHARE}


def with_bad(
    scale: float,
    zero: float = 0.01,
    route: Sequence[tuple[float, float]] = RAMP,
    off_m: float = 3.0,
    site: Site = soils,
) -> dict[str, Table]:
    """The fleet plus a machine with high torque and a displaced antenna."""
    rows = fleet(site) | {"bad": drive(route, Errors(zero, scale), seed=99, site=site)}
    rows["bad"]["y_m"] += off_m
    return rows


def of_others(result: Solution) -> tuple[Correction, ...]:
    return tuple(each for each in result.corrections if each.machine != "bad")


def test_a_machine_without_a_say_moves_nobody() -> None:
    rows, without = with_bad(0.1), usual()
    excluded = solve(rows, ("bad",))
    assert of_others(excluded) == without.corrections
    assert excluded.common == without.common
    assert of_others(solve(rows)) != without.corrections


@pytest.mark.parametrize(("scale", "zero"), [(-0.45, 0.0), (0.1, 0.04)])
def test_a_machine_at_fault_has_no_say_though_nobody_said_so(scale: float, zero: float) -> None:
    result = solve(with_bad(scale, zero))
    assert of_others(result) == usual().corrections
    assert max(np.divide(result.machines["bad"].beyond, FAULT_SIGMAS)) > 1


def test_of_slopes_that_contradict_each_other_nobody_is_at_fault() -> None:
    """One machine measures half its force where few others pass: no single one may be blamed."""
    rows = fleet()
    rows["ramp"]["c_rr"] -= 0.5 * (rows["ramp"]["c_rr"] + rows["ramp"]["grade_e"])
    result = solve(rows)
    assert not result.common.observed
    for name, state in result.machines.items():
        assert state.scale == 0.0, name
        assert state.beyond[1] == 0.0, name
        assert state.scale_std == pytest.approx(SCALE_STD, rel=0.05), name


@pytest.mark.parametrize("factor", [0.0, 3.0])
def test_of_a_sensor_that_measures_no_force_slopes_alone_are_corrected(factor: float) -> None:
    rows = fleet()
    share = rows["low"]["c_rr"].copy()
    rows["low"]["c_rr"] += (factor - 1) * share
    result = solve(rows)
    own = [each for each in result.corrections if each.machine == "low"]
    assert corrected(rows["low"], own)["c_rr"].tobytes() == rows["low"]["c_rr"].tobytes()
    assert [each.zero for each in own] == pytest.approx([FLEET["low"][1].zero] * len(own), abs=0.0016)
    earlier = Correction("low", 0, LAST_NS, 0.004, 0.4, 0.0, own[0].covariance)
    assert differs(own[-1], earlier), "what was taken off before its sensor broke does not hold on"
    assert result.machines["low"].beyond[1] > FAULT_SIGMAS[1]
    check(result.machines["ramp"], FLEET["ramp"][1])


def test_on_level_ground_a_gain_unlike_all_others_is_a_fault_and_corrected() -> None:
    rows = {name: drive(LOW, Errors(0.002), seed=i) for i, name in enumerate("abc")}
    rows["d"] = drive(LOW, Errors(0.002, 0.6), seed=9)
    result = solve(rows)
    assert result.common.reason == "no_slope_both_ways"
    assert result.machines["d"].beyond[1] > FAULT_SIGMAS[1]
    (first, *_) = [each for each in result.corrections if each.machine == "d"]
    assert first.scale == pytest.approx(0.6 / 1.6, abs=0.05)
    assert {each.scale for each in result.corrections if each.machine != "d"} == {0.0}
    two = solve({"a": rows["a"], "d": rows["d"]})  # either may be wrong
    assert all(state.beyond[1] < FAULT_SIGMAS[1] for state in two.machines.values())


def test_rain_between_two_machines_is_not_their_error() -> None:
    wet: Site = lambda x, y, h: soils(x, y, h) + 0.02  # noqa: E731
    rows = {
        "low": drive(LOW, FLEET["low"][1], seconds=900.0),
        "ramp": drive(RAMP, FLEET["ramp"][1], site=wet, seed=1, start_s=900.0),
        "again": drive(RAMP_AGAIN, FLEET["again"][1], site=wet, seed=2, start_s=900.0),
    }
    result = solve(rows)
    for name in ("ramp", "again"):
        check(result.machines[name], FLEET[name][1], zero=0.002, scale=0.03)
    assert result.machines["low"].zero == pytest.approx(FLEET["low"][1].zero, abs=0.002)


def test_known_ground_shows_the_zero_where_nothing_is_closed() -> None:
    rows = drive(OPEN, Errors(0.006), seconds=200.0, closed=False, site=concrete)
    area = KnownGround("apron", 0.008, ((300.0, 50.0), (700.0, 50.0), (700.0, 90.0), (300.0, 90.0)))
    result = solve({"a": rows}, areas=[area])
    assert result.machines["a"].zero == pytest.approx(0.006, abs=0.002)
    assert result.machines["a"].zero_by == ("known_ground",)


def test_cells_at_the_edge_of_known_ground_are_not_known() -> None:
    area = KnownGround("apron", 0.008, ((0.0, 0.0), (40.0, 0.0), (40.0, 40.0), (0.0, 40.0)))
    p, _, cells = passages(ledgers({"a": drive(LOW, seconds=60.0)}))
    known = np.isfinite(known_cells(cells, [area]))[p.cell]
    inside = ((p.place_m > 7.5) & (p.place_m < 32.5)).all(axis=1)
    outside = ((p.place_m < 4.5) | (p.place_m > 35.5)).any(axis=1)
    assert set(known[inside].tolist()) == {True}
    assert set(known[outside].tolist()) == {False}


def test_any_order_of_samples_and_machines_gives_the_same_facts() -> None:
    rows = fleet()
    draw = np.random.default_rng(0)
    mixed = {name: draw.permutation(rows[name]) for name in draw.permutation(list(rows)).tolist()}
    assert solve(mixed) == usual()


def test_corrections_are_rounded_follow_each_other_and_the_newest_holds_on() -> None:
    result = usual()
    for name in FLEET:
        own = [each for each in result.corrections if each.machine == name]
        assert all(a.to_ns <= b.from_ns for a, b in pairwise(own))
        assert own[-1].to_ns > START_NS + 10**18
        assert all(value == round(value, 5) for each in own for value in (each.zero, each.scale, each.across))
        assert min(each.covariance[0][0] for each in own) >= 0.0004**2
        assert min(each.covariance[1][1] for each in own) >= 0.004**2
        assert all(np.linalg.eigvalsh(np.array(each.covariance)).min() > 0 for each in own)


def test_nothing_is_solved_of_nothing() -> None:
    assert calibrate({}).corrections == ()
    assert solve({"a": drive(LOW, seconds=10.0)[:0]}).machines == {}
    assert solve({"a": drive(LOW, seconds=10.0)}, ("a",)).corrections == ()
    one = solve({"a": drive(LOW, seconds=10.0)[:1]})
    assert one.machines["a"].zero == 0.0
    flood = {"flood": np.repeat(drive(LOW, seconds=10.0)[:1], 5000)}
    assert solve(flood).machines == {}
    assert solve(fleet() | flood).corrections == usual().corrections, "and it keeps nobody from being calibrated"


@pytest.mark.nightly
def test_a_hundred_machines_take_a_gigabyte_at_most() -> None:
    """Bounded evidence of four hours each: a solve takes a bounded number of epochs."""
    of_each = ledgers(
        {
            str(i): drive(route, Errors(0.002 * i, 0.02 * i), seconds=4 * 3600.0, seed=i, late=False)
            for i, (route, _) in enumerate(FLEET.values())
        }
    )
    stays = {f"m{i:03d}": of_each[str(i % 3)] for i in range(MOST_MACHINES)}
    tracemalloc.start()
    result = calibrate(stays)
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most_bytes < 0.7e9  # beyond the program's own memory
    assert len(result.corrections) == MOST_EPOCHS
    assert result.common.observed
    one = calibrate({name: newest(stays[name], epochs_of_each(3)) for name in ("m000", "m001", "m002")})
    assert result.machines["m001"].zero == pytest.approx(one.machines["m001"].zero, abs=0.002)


def test_more_machines_are_solved_in_groups() -> None:
    names = [f"m{i:03d}" for i in range(2 * MOST_MACHINES + 1)]
    assert groups([]) == [()]
    assert groups(names[:MOST_MACHINES]) == [tuple(names[:MOST_MACHINES])]
    some = groups(reversed(names))
    assert (len(some), sorted(name for group in some for name in group)) == (3, names)
    assert [epochs_of_each(n) for n in (0, 1, 20, 21, 100, 5000)] == [EPOCHS, EPOCHS, EPOCHS, 47, 10, 10]


def test_what_groups_say_is_joined_and_the_common_scale_is_the_least_known() -> None:
    parts = [solve({name: drive(route, Errors(0.004, 0.03))}) for name, route in (("a", LOW), ("b", RAMP))]
    whole = joined(parts)
    assert {*whole.machines} == {*whole.stated} == {one.machine for one in whole.corrections} == {"a", "b"}
    assert whole.machines["b"] == parts[1].machines["b"]
    assert parts[1].common.observed
    assert whole.common == parts[0].common
