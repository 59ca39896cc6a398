import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from agents.estimation.ground import NOTHING_KNOWN, GroundEstimate
from agents.localisation.filters.belief import PoseBelief
from agents.sampling import EVERY_M, HISTORY_S, LAG_S, FuelMeter, Odometer, PoseHistory, Sampler
from protocol.arrays import Table
from protocol.machine.readings import FuelRate
from protocol.machine.samples import GRADE, RESISTANCE, check_samples

S = 10**9
ESTIMATE = GroundEstimate(0.05, 1e-4, 0.2, 0.1, 1e-3, "", mass_kg=22_000.0)


def ns(seconds: float) -> int:
    return round((100 + seconds) * S)


def pose(seconds: float, x_m: float = 0.0, heading_rad: float = 0.0, variance_m2: float = 1.0) -> PoseBelief:
    return PoseBelief(ns(seconds), x_m, 5.0, heading_rad, 2.0, np.diag([variance_m2, 2 * variance_m2]))


class Asked:
    """An estimator that records its queries."""

    def __init__(self, estimate: GroundEstimate) -> None:
        self.stamps_ns: list[int] = []
        self._estimate = estimate

    def __call__(self, stamp_ns: int) -> GroundEstimate:
        self.stamps_ns.append(stamp_ns)
        return self._estimate


def drive(sampler: Sampler, estimate: GroundEstimate = ESTIMATE, **options: float) -> Table:
    """10 m east at 2 m/s from x = 0, poses and wheels at 20 Hz, then the lag."""
    rows = []
    for i in range(101):
        sampler.poses.append(pose(i * 0.05, 0.1 * i, **options))
        sampler.mark(ns(i * 0.05), 0.1 * i)
        rows.append(sampler.due_samples(ns(i * 0.05), Asked(estimate)))
    return np.concatenate([*rows, sampled(sampler, estimate, now_s=5.0)])


def sampled(sampler: Sampler, estimate: GroundEstimate = ESTIMATE, now_s: float = 0.0) -> Table:
    """Due after the lag."""
    return sampler.due_samples(ns(now_s + LAG_S), Asked(estimate))


# --- one per stretch, at the machine's place -------------------------------------------------------------------------


def test_one_sample_per_stretch_that_says_how_long_it_is() -> None:
    sampler = Sampler(1.5)
    rows = drive(sampler)
    assert len(rows) == 10 / EVERY_M
    assert not sampler.withheld
    assert not sampler.without_resistance
    assert rows["distance_m"] == pytest.approx(EVERY_M)
    assert rows["x_m"] == pytest.approx(1.5 + EVERY_M * np.arange(1, len(rows) + 1))
    check_samples(rows, 1e4)


@pytest.mark.parametrize("heading", [0.7, -2.0])
def test_load_centre_lies_ahead_and_the_gradient_is_turned_into_the_map(heading: float) -> None:
    sampler = Sampler(1.5)
    sampler.poses.append(pose(0, heading_rad=heading))
    sampler.mark(ns(0), 30.0)
    (row,) = sampled(sampler)
    assert row["distance_m"] == 2 * EVERY_M, "at most"
    assert (row["x_m"], row["y_m"]) == pytest.approx((1.5 * math.cos(heading), 5.0 + 1.5 * math.sin(heading)))
    ahead, left = complex(math.cos(heading), math.sin(heading)), complex(-math.sin(heading), math.cos(heading))
    expected = 0.2 * ahead + 0.1 * left
    assert complex(row["grade_e"], row["grade_n"]) == pytest.approx(expected, abs=1e-6)
    assert (row["c_rr"], row["c_rr_var"], row["grade_var"]) == pytest.approx((0.05, 1e-4, 1e-3))
    assert (row["cov_xx_m2"], row["cov_xy_m2"], row["cov_yy_m2"]) == (1.0, 0.0, 2.0)


def test_estimator_is_asked_for_the_stamp_of_the_mark_once_the_lag_has_passed() -> None:
    sampler, asked = Sampler(0.0), Asked(ESTIMATE)
    for t in (0.0, 0.5, LAG_S - 0.001, LAG_S, LAG_S + 0.2):
        sampler.poses.append(pose(t))
        if t == 0.0:
            sampler.mark(ns(0), 0.5)
        rows = sampler.due_samples(ns(t), asked)
        assert (len(rows), sampler.waiting) == ((1, 0) if t == LAG_S else (0, int(t < LAG_S)))
    assert asked.stamps_ns == [ns(0)]


def moved(by_m: float, turn_rad: float, variance_m2: float) -> Callable[[PoseBelief], PoseBelief]:
    def corrected(p: PoseBelief) -> PoseBelief:
        place = (p.x_m + by_m, p.y_m, p.heading_rad + turn_rad)
        return PoseBelief(p.stamp_ns, *place, p.speed_mps, variance_m2 * np.eye(2))

    return corrected


def test_final_sample_is_that_of_the_corrected_pose() -> None:
    """Load centre and gradient turn with the heading; measured values stay."""
    sampler = Sampler(1.5)
    (pending,) = drive(sampler)[:1]
    (final,) = sampler.final_samples(lambda p: moved(3.0, 0.5, 0.25)(p) if p.x_m < 0.75 else None)
    c, s = math.cos(0.5), math.sin(0.5)
    assert (final["x_m"], final["y_m"]) == pytest.approx((0.5 + 3.0 + 1.5 * c, 5.0 + 1.5 * s))
    assert (final["grade_e"], final["grade_n"]) == pytest.approx((0.2 * c - 0.1 * s, 0.2 * s + 0.1 * c))
    assert [final[name] for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")] == [0.25, 0.0, 0.25]
    assert final["heading_rad"] == pytest.approx(0.5)
    same = ("stamp_ns", "speed_mps", "distance_m", "c_rr", "c_rr_var", "grade_var")
    assert [final[name] for name in same] == [pending[name] for name in same]


# --- withheld --------------------------------------------------------------------------------------------------------


def test_marks_before_the_first_pose_are_counted() -> None:
    sampler = Sampler(0.0)
    for t in (-1.0, -0.5, 0.5):
        sampler.mark(ns(t), t + 2)
    sampler.poses.append(pose(0))
    sampler.poses.append(pose(1))
    assert len(sampled(sampler, now_s=1.0)) == 1
    assert sampler.withheld == {"no_pose": 2}


@pytest.mark.parametrize(
    ("estimate", "unknown"),
    [
        (replace(NOTHING_KNOWN, reason="pitch_transient", mass_kg=22_000.0), (*RESISTANCE, *GRADE)),
        (replace(ESTIMATE, c_rr=math.nan, c_rr_var=math.nan, reason="braking"), RESISTANCE),
    ],
)
def test_what_is_not_known_of_the_ground_is_counted_and_the_rest_is_sampled(
    estimate: GroundEstimate, unknown: tuple[str, ...]
) -> None:
    sampler = Sampler(0.0)
    rows = drive(sampler, estimate)
    assert len(rows) == 20
    assert {name for name in (*RESISTANCE, *GRADE) if np.isnan(rows[name]).all()} == set(unknown)
    assert rows["mass_kg"] == pytest.approx(22_000.0)
    assert rows["distance_m"] == pytest.approx(drive(Sampler(0.0))["distance_m"])
    assert (sampler.without_resistance, sampler.withheld) == ({estimate.reason: 20}, {})
    check_samples(rows, 1e4)


def test_samples_of_an_unsure_place_are_withheld_and_counted() -> None:
    sampler = Sampler(0.0)
    assert not len(drive(sampler, variance_m2=201.0))  # twice as much north: std 20.05 m
    assert sampler.withheld == {"unsure_position": 20}


# --- the odometer ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("speed_mps", [2.0, -2.0], ids=["forwards", "reverse"])
def test_distance_goes_on_by_the_filter_s_speed_when_wheels_fall_silent(speed_mps: float) -> None:
    """From their last reading, noticed 0.5 s later; increasing in reverse too."""
    odometer = Odometer()
    odometer.update(ns(0.0), ns(0.0), 5.0, speed_mps)
    distances = [odometer.update(ns(i * 0.01), ns(0.0), 5.0, speed_mps) for i in range(1, 1001)]
    assert distances[49] == 5.0
    assert distances[-1] == pytest.approx(5.0 + 2.0 * 10.0, abs=1.1)
    assert (np.diff(distances) >= 0).all()


def test_wheels_that_are_read_again_count_on_and_nothing_twice() -> None:
    odometer = Odometer()
    odometer.update(ns(0.0), ns(0.0), 5.0, 2.0)
    for i in range(1, 301):  # dead reckoning over ground continues
        before = odometer.update(ns(i * 0.01), ns(0.0), 5.0 + 0.02 * i, 2.0)
    assert odometer.update(ns(3.01), ns(3.01), 11.0, 2.0) == pytest.approx(before)  # counted from their last place
    after = odometer.update(ns(3.05), ns(3.05), 11.1, 2.0)
    assert after == pytest.approx(before + 0.1)


def test_noise_of_the_filter_s_speed_at_a_standstill_is_no_distance() -> None:
    odometer = Odometer()
    start = odometer.update(ns(0.0), 0, 0.0, 0.0)
    assert [odometer.update(ns(i * 0.01), 0, 0.0, 0.29 * (-1) ** i) for i in range(1, 1000)] == [start] * 999


# --- past poses ------------------------------------------------------------------------------------------------------


def test_history_interpolates_between_its_ends_and_takes_the_short_way_across_the_back_heading() -> None:
    history = PoseHistory()
    assert history.at(100 * S) is None
    history.append(pose(0, 1.0))
    history.append(pose(0, 0.0, math.pi - 0.1))  # same stamp: replaces the last
    history.append(pose(1, 4.0, -math.pi + 0.3, variance_m2=3.0))
    middle = history.at(100 * S + S // 2)
    assert math.remainder(middle.heading_rad - (math.pi + 0.1), math.tau) == pytest.approx(0, abs=1e-12)
    assert -math.pi <= middle.heading_rad <= math.pi
    assert (middle.x_m, middle.speed_mps, middle.covariance_m2[0, 0]) == pytest.approx((2.0, 2.0, 2.0))
    assert [history.at((100 + seconds) * S).x_m for seconds in (0, 1)] == [0.0, 4.0]
    assert history.at(100 * S - 1) is history.at(101 * S + 1) is None


def test_history_forgets_but_never_what_it_has_to_keep() -> None:
    history = PoseHistory()
    for i in range(1000):
        history.append(pose(i * 0.1, float(i)))
        if i >= 10 * HISTORY_S:
            assert history.at(round((100 + i * 0.1 - HISTORY_S) * S) + 1)
    assert len(history._poses) <= 20 * HISTORY_S + 2


def test_fuel_of_a_sample_is_what_was_burned_while_it_moved() -> None:
    """36 l/h are 0.01 l/s, none at standstill; after a pause a stretch has none."""
    meter = FuelMeter()
    assert math.isnan(meter.take(ns(0.0)))
    for i in range(11):
        meter.add(FuelRate("fuel", ns(0.1 * i), 36.0), 2.0)
    assert meter.take(ns(1.05)) == pytest.approx(0.01)
    for i in range(11, 21):
        meter.add(FuelRate("fuel", ns(0.1 * i), 36.0), 0.0)
    assert meter.take(ns(2.0)) == 0.0
    meter.add(FuelRate("fuel", ns(4.0), 36.0), 2.0)
    assert math.isnan(meter.take(ns(4.1)))
    meter.add(FuelRate("fuel", ns(4.2), 36.0), 2.0)
    assert meter.take(ns(4.3)) == pytest.approx(0.002)
    assert math.isnan(meter.take(ns(9.0)))
    meter.add(FuelRate("fuel", ns(1.0), 36.0), 2.0)  # clock set back
    assert math.isnan(meter.take(ns(1.1)))
