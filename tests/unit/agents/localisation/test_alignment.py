import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.dead_reckoning import DeadReckonedPose, WheelSpeed
from agents.localisation.alignment import align, align_fixes, align_start, start_belief
from agents.localisation.filters.state import ATTITUDE, SPEED, YAW, Layout
from agents.localisation.fix import Fix
from agents.localisation.imu_steps import FilterStep
from protocol.machine.machine_config import Mount, SensorConfig
from protocol.units import GRAVITY_MPS2


def test_no_alignment_where_all_positions_coincide() -> None:
    assert align(np.full((9, 2), 3.0), np.random.default_rng(0).normal(size=(9, 2)), np.ones(9)) is None


def fixes(length_m: float, turn_rad: float, n: int = 8, **options: Any) -> list[Fix]:
    """Of a straight drive ahead in dead reckoning, that leads from (5, 7) in a direction of the map; 1 and 3 m2."""
    sensor = SensorConfig("gps", "gps", Mount((1.0, 0.0, 3.0)), **options)
    along = np.linspace(0.0, length_m, n)
    c, s = math.cos(turn_rad), math.sin(turn_rad)
    return [
        Fix(i, sensor, np.array([5 + c * (x + 1), 7 + s * (x + 1)]), np.array([1.0, 3.0]), reckoned(x))
        for i, x in enumerate(along.tolist())
    ]


def stating(collected: list[Fix], std_m: float) -> list[Fix]:
    return [replace(fix, variance_m2=np.full(2, std_m**2)) for fix in collected]


def reckoned(x_m: float = 0.0) -> DeadReckonedPose:
    return DeadReckonedPose(0, x_m, 0.0, x_m, 0.0)


@pytest.mark.parametrize(
    "collected",
    [
        fixes(20.0, 0.9, n=3),  # too few
        fixes(2.0, 0.9),  # there and back, in one place
        fixes(20.0, 0.9, mode="relative"),  # nothing absolute
        stating(fixes(20.0, 0.9), 30.0),  # too uncertain
        [*stating(fixes(20.0, 0.9), 30.0), *fixes(2.0, 0.9)],  # what is sure has no spread
    ],
)
def test_heading_is_not_taken_from_too_little(collected: list[Fix]) -> None:
    assert align_fixes(collected) is None


def shifted(collected: list[Fix], east_m: float) -> list[Fix]:
    return [replace(fix, position_m=fix.position_m + np.array([east_m, 0.0])) for fix in collected]


@pytest.mark.parametrize("first_off", [2, 8])
def test_a_first_stretch_that_is_off_does_not_count(first_off: int) -> None:
    """By 40 m, which the receiver does not state."""
    whole = fixes(40.0, 0.9, n=20)
    alignment = align_fixes([*shifted(whole[:first_off], 40.0), *whole[first_off:]])
    assert alignment.rotation_rad == pytest.approx(0.9)
    assert alignment.origin_m == pytest.approx((5.0, 7.0))
    assert alignment.since_ns == first_off


def step(force: tuple[float, float, float] | None = None) -> tuple[FilterStep, list[Any]]:
    first = FilterStep(
        9, DeadReckonedPose(9, 0.0, 0.3, 0.0, 0.0), {}, {}, WheelSpeed(1.5, is_known=True), True, 0.0, 0.0
    )
    return first, [np.array(force)] if force else []


def test_start_lies_where_it_is_given_and_as_the_forces_show() -> None:
    """0.1 rad to its right side and 0.2 rad nose up."""
    force = (GRAVITY_MPS2 * math.sin(0.2), GRAVITY_MPS2 * math.sin(0.1), 9.0)
    alignment = align_start((50.0, 60.0, 3.0), step()[0].reckoned)
    belief = start_belief(alignment, *step(force), Layout(imus=1, wheel_scale=True), 0.0)
    assert belief.x[:2] == pytest.approx((50.0, 60.0))
    assert belief.x[ATTITUDE] == pytest.approx((0.1, -0.2, 3.0))
    assert (belief.stamp_ns, belief.x[SPEED]) == (9, 1.5)
    assert np.linalg.eigvalsh(belief.P).min() > 0
    unforced = start_belief(alignment, *step(), Layout(), 0.0)
    assert unforced.x[ATTITUDE][:2].tolist() == [0.0, 0.0]


def test_start_is_where_the_machine_is_now_not_where_dead_reckoning_began() -> None:
    """Reckoned 3 m ahead and 4 m to the left, turned by 0.3 rad, before the start is applied."""
    alignment = align_start((50.0, 60.0, 3.0), DeadReckonedPose(9, 5.0, 0.3, 3.0, 4.0))
    moved = replace(step()[0], reckoned=DeadReckonedPose(9, 5.0, 0.3, 3.0, 4.0))
    belief = start_belief(alignment, moved, [], Layout(), 0.0)
    assert belief.x[:2] == pytest.approx((50.0, 60.0))
    assert belief.x[YAW] == pytest.approx(3.0)
    back = start_belief(alignment, step()[0], [], Layout(), 0.0)  # the first step, where it had only turned by 0.3 rad
    c, s = math.cos(2.7), math.sin(2.7)
    assert back.x[:2] == pytest.approx((50.0 - 3 * c + 4 * s, 60.0 - 3 * s - 4 * c))


def test_align_recovers_rotation_and_shift() -> None:
    rng = np.random.default_rng(1)
    reckoned = rng.uniform(-20, 20, (30, 2))
    rotation, shift = rng.uniform(-math.pi, math.pi), rng.uniform(-500, 500, 2)
    c, s = math.cos(rotation), math.sin(rotation)
    alignment, first = align(reckoned, reckoned @ np.array([[c, s], [-s, c]]) + shift, np.full(30, 4.0))
    assert first == 0
    assert alignment.rotation_rad == pytest.approx(rotation)
    assert alignment.origin_m == pytest.approx(tuple(shift))
    spread_m = float(np.sqrt(reckoned.var(axis=0).sum()))
    assert alignment.std_rad == pytest.approx(2.0 / (2 * spread_m))
