import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.localisation import measurements
from agents.localisation.filters.belief import Belief, Filter, Measurement
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.late_measurements import Fusion
from agents.localisation.filters.motion import MotionModel, motion
from agents.localisation.filters.state import POSITION, SPEED, YAW, Layout
from agents.localisation.filters.ukf import Ukf
from protocol.units import GRAVITY_MPS2

LAYOUT = Layout()
MODEL = MotionModel(LAYOUT)
MS = 1_000_000
START_NS = 1_767_225_600_000_000_000
BOTH = pytest.mark.parametrize("engine", [Ekf(), Ukf()], ids=["ekf", "ukf"])


def start() -> Belief:
    """2 m/s to the north-east."""
    x = np.zeros(LAYOUT.n)
    x[YAW], x[SPEED] = 0.7, 2.0
    return Belief(START_NS, x, np.eye(LAYOUT.n) * 0.01)


def fused(engine: Filter | None = None, **options: Any) -> Fusion:
    return Fusion(engine or Ekf(), MODEL, start(), **options)


def fix(ms: float, east_m: float = 0.0, north_m: float = 0.0, sensor: str = "gps-1", gate: float = 0.0) -> Measurement:
    """A fix with this offset from an undisturbed drive; lever arm."""
    distance_m = 2.0 * ms / 1000
    position = np.array([distance_m * math.cos(0.7) + east_m, distance_m * math.sin(0.7) + north_m])
    lever = np.array([0.0, 0.0, 3.0])
    return measurements.fix(START_NS + round(ms * MS), sensor, position, np.eye(2), lever, None, gate)


def wheels(ms: float, speed_mps: float = 2.0) -> Measurement:
    return measurements.wheels(
        START_NS + round(ms * MS), "wheels", np.array([speed_mps, 0, 0]), np.eye(3) * 1e-2, None, 0.0
    )


def imu(ms: float) -> Measurement:
    z, R = np.array([0.0] * 5 + [GRAVITY_MPS2]), np.diag([1e-4] * 3 + [1.0] * 3)
    return measurements.inertial(START_NS + round(ms * MS), "imu", z, R, np.zeros(3), None, 0.0)


def drive(seed: int, seconds: float = 2.0) -> list[list[Measurement]]:
    """Noisy groups: IMU and wheels of one stamp, two receivers' fixes between."""
    rng = np.random.default_rng(seed)
    groups = [[imu(t), wheels(t, 2.0 + rng.normal(scale=0.1))] for t in np.arange(50, seconds * 1000, 50)]
    for sensor, every_ms in (("gps-1", 193), ("gps-2", 311)):
        groups += [[fix(t, *rng.normal(size=2), sensor)] for t in np.arange(every_ms, seconds * 1000, every_ms)]
    return sorted(groups, key=lambda group: group[0].stamp_ns)


def same(a: Belief, b: Belief, seed: str = "") -> None:
    assert a.stamp_ns == b.stamp_ns, seed
    assert a.x == pytest.approx(b.x, abs=1e-9), seed
    assert np.abs(a.P - b.P).max() < 1e-9, seed


def plainly(engine: Filter, groups: list[list[Measurement]], belief: Belief) -> Belief:
    """Plain filtering, in order."""
    for measurement in itertools.chain(*groups):
        dt_s = (measurement.stamp_ns - belief.stamp_ns) * 1e-9
        if dt_s:
            belief = engine.predict(belief, motion(MODEL, belief, dt_s), measurement.stamp_ns)
        belief = engine.condition(belief, measurement).belief
    return belief


def test_only_a_fix_makes_the_place_unsure_when_it_is_believed_again() -> None:
    """A differential receiver's velocity (2,) says nothing of the place."""
    velocity = measurements.velocity(START_NS + 50 * MS, "gps-1", np.array([90.0, 0.0]), np.eye(2), np.zeros(3), 4.0)
    variances = []
    for measurement in (velocity, fix(50, 90.0, gate=4.0)):
        fusion = fused(relock=1)
        fusion.add([measurement])
        assert fusion.counters["gps-1_relocked"] == 1
        variances.append(fusion.belief.P[0, 0])
    assert variances[0] < 0.02
    assert variances[1] > 0.9


# --- order -----------------------------------------------------------------------------------------------------------


@BOTH
def test_any_order_within_the_window_gives_the_belief_of_plain_filtering(engine: Filter) -> None:
    seed = 1
    groups = drive(seed)
    rng = np.random.default_rng(seed)
    # by arrival, each up to 0.4 s late
    arrival = [group[0].stamp_ns + rng.uniform(0, 400) * MS for group in groups]
    shuffled = [groups[i] for i in np.argsort(arrival)]
    assert [g[0].stamp_ns for g in shuffled] != [g[0].stamp_ns for g in groups]
    late = fused(engine)
    for group in shuffled:
        late.add(group)
    same(late.belief, plainly(engine, groups, start()), f"seed={seed}")
    assert late.counters["too_late"] == late.counters["duplicate"] == 0


def test_a_late_measurement_changes_its_own_belief_and_all_after_it() -> None:
    fusion = fused()
    for t in (100, 200, 300, 400):
        fusion.add([wheels(t)])
    changed = fusion.add([fix(250, 1.0)])
    assert [b.stamp_ns for b in changed] == [START_NS + t * MS for t in (250, 300, 400)]
    assert all(b.x[0] > fusion.at(START_NS + 240 * MS).x[0] + 0.005 for b in changed)
    same(changed[-1], fusion.belief)


@pytest.mark.parametrize(("ms", "accepted"), [(901, True), (900, False), (899, False), (100, False), (-1, False)])
def test_what_lies_before_the_window_is_refused_and_counted(ms: int, accepted: bool) -> None:
    fusion = fused(window_s=1.0)
    for t in range(100, 2000, 100):
        fusion.add([wheels(t)])
    before = fusion.belief
    assert bool(fusion.add([fix(ms, 5.0), replace(fix(ms), sensor="gps-2")])) is accepted
    assert fusion.counters["too_late"] == (0 if accepted else 2)
    assert (fusion.belief is before) is not accepted


def test_the_window_begins_at_the_start_and_moves_on_where_measurements_are_rare_too() -> None:
    fusion = fused(window_s=1.0)
    assert fusion.add([wheels(-1)]) == []
    assert fusion.add([wheels(0)])
    fusion.add([wheels(10_000)])
    assert fusion.add([wheels(8_999)]) == []
    assert fusion.counters["too_late"] == 2


def test_a_duplicate_is_refused_and_counted() -> None:
    fusion = fused()
    for t in (100, 200, 300):
        fusion.add([fix(t, 1.0)])
    before = fusion.belief
    for t in (300, 200):
        assert fusion.add([fix(t, 7.0)]) == []
    assert fusion.belief is before
    assert (fusion.counters["duplicate"], fusion.counters["gps-1_used"]) == (2, 3)
    assert len(fusion.add([fix(300, 1.0), replace(fix(300), sensor="gps-2")])) == 1  # its new part counts
    assert (fusion.counters["duplicate"], fusion.counters["gps-2_used"]) == (3, 1)


# --- gates -----------------------------------------------------------------------------------------------------------


def test_outlier_is_gated_counted_and_changes_nothing() -> None:
    fusion = fused()
    fusion.add([wheels(100)])
    before = fusion.at(START_NS + 200 * MS)
    (after,) = fusion.add([fix(200, 60.0, gate=4.0)])
    same(after, before)
    assert fusion.counters == {"wheels_used": 1, "gps-1_gated": 1, "duplicate": 0}
    assert not fusion.last["gps-1"].accepted
    assert fusion.last["gps-1"].nis > 16


def test_a_sensor_is_believed_again_after_so_many_refusals_in_a_row() -> None:
    fusion = fused(relock=5)
    for i in range(1, 5):
        fusion.add([fix(100 * i, 60.0, gate=4.0)])
    assert fusion.counters["gps-1_relocked"] == 0
    assert abs(fusion.belief.x[0]) < 3
    fusion.add([fix(500, 60.0, gate=4.0)])
    assert (fusion.counters["gps-1_gated"], fusion.counters["gps-1_relocked"]) == (5, 1)
    assert fusion.belief.x[:2] == pytest.approx(fix(500, 60.0).z, abs=1.0)
    fusion.add([fix(600, 60.0, gate=4.0)])
    assert fusion.counters["gps-1_used"] == 1


def test_refusals_count_in_a_row_and_by_sensor() -> None:
    fusion = fused(relock=3)
    for i in range(1, 10):
        off_m = 0.0 if i % 3 == 0 else 60.0  # never three in a row
        fusion.add([fix(100 * i, off_m, gate=4.0), fix(100 * i, 0.0, sensor="gps-2", gate=4.0)])
    assert (fusion.counters["gps-1_gated"], fusion.counters["gps-1_relocked"]) == (6, 0)
    assert (fusion.counters["gps-2_used"], fusion.counters["gps-2_gated"]) == (9, 0)


def test_a_late_measurement_does_not_undo_that_a_sensor_is_believed_again() -> None:
    fusion = fused(relock=3)
    for i in range(1, 5):
        fusion.add([fix(100 * i, 60.0, gate=4.0)])
    assert fusion.counters["gps-1_relocked"] == 1
    fusion.add([wheels(150)])
    assert fusion.belief.x[:2] == pytest.approx(fix(400, 60.0).z, abs=1.0)
    assert fusion.counters["gps-1_relocked"] == 1


@pytest.mark.parametrize("relocks", [True, False])
def test_sensors_that_are_no_position_are_believed_again_too_and_what_is_assumed_never_is(relocks: bool) -> None:
    fusion = fused(relock=3)
    for t in (10, 20):
        fusion.add([replace(wheels(t, 9.0), gate_sigma=4.0, relocks=relocks)])
    assert fusion.belief.x[SPEED] == pytest.approx(2.0, abs=0.1)
    fusion.add([replace(wheels(30, 9.0), gate_sigma=4.0, relocks=relocks)])
    assert (fusion.counters["wheels_gated"], fusion.counters["wheels_relocked"]) == (3, int(relocks))
    assert bool(fusion.belief.x[SPEED] > 3.0) is relocks


@pytest.mark.parametrize("broken", [{"z": np.array([np.nan, 0.0])}, {"R": np.full((2, 2), np.nan)}, {"R": -np.eye(2)}])
def test_an_invalid_measurement_is_counted_and_changes_nothing(broken: dict[str, Any]) -> None:
    bad = replace(fix(200), **broken)
    fusion = fused(relock=1)
    fusion.add([wheels(100)])
    before = fusion.at(bad.stamp_ns)
    (after,) = fusion.add([bad])
    same(after, before)
    assert fusion.counters == {"wheels_used": 1, "gps-1_invalid": 1, "duplicate": 0}


# --- beliefs ---------------------------------------------------------------------------------------------------------


@BOTH
def test_beliefs_are_predicted_between_and_beyond(engine: Filter) -> None:
    fusion = fused(engine)
    between = fusion.add([wheels(100)])[0]
    fusion.add([wheels(300)])
    for stamp_ns, last in ((START_NS + 200 * MS, between), (START_NS + 900 * MS, fusion.belief)):
        dt_s = (stamp_ns - last.stamp_ns) * 1e-9
        same(fusion.at(stamp_ns), engine.predict(last, motion(MODEL, last, dt_s), stamp_ns))
    assert fusion.at(START_NS + 100 * MS) is between
    assert fusion.at(START_NS + 900 * MS).x[:2] == pytest.approx(fix(900).z, abs=0.03)
    assert fusion.belief.stamp_ns == START_NS + 300 * MS  # asking changes nothing


def test_history_is_no_longer_than_the_window() -> None:
    fusion = fused(window_s=0.5)
    for t in range(10, 2000, 10):
        fusion.add([wheels(t)])
    assert len(fusion._nodes) <= 51


def known_anew(belief: Belief) -> Belief:
    """Another position, like a state's first value."""
    x = belief.x.copy()
    x[POSITION.start] = 40.0
    return replace(belief, x=x)


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_a_change_stays_where_it_was_made(order: tuple[int, ...]) -> None:
    """Applied before its measurement, however late, and again on older arrivals."""
    steps = [wheels(100), replace(fix(200), change=known_anew), fix(300, 40.0)]
    in_order, fusion = fused(), fused()
    for measurement in steps:
        in_order.add([measurement])
    for i in order:
        fusion.add([steps[i]])
    same(fusion.belief, in_order.belief)
    assert fusion.belief.x[0] > 20
