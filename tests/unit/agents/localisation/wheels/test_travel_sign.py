"""Speed sign by the forward accelerometer."""

import math

import numpy as np
import pytest

from agents.localisation.wheels.travel_sign import TravelSign
from protocol.units import GRAVITY_MPS2

STEP_S = 0.05


def driven(
    *, sign: float, seed: int, seconds: float = 30.0, every_s: float = 0.5, accel_mps2: float = 0.8, grade: float = 0.0
) -> TravelSign:
    """Stop and go on a steepening hill; cheap accelerometer, Doppler of 0.1 m/s."""
    noise, judge, speed, before = np.random.default_rng(seed), TravelSign(), 0.0, 0.0
    for step in range(1, round(seconds / STEP_S)):
        t = step * STEP_S
        accel = accel_mps2 * math.sin(2 * math.pi * t / 12.0)
        slope = grade * math.sin(2 * math.pi * t / 40.0)
        speed += accel * STEP_S
        rate = (slope - before) / STEP_S + 0.005 + noise.normal(0, 0.01)
        before = slope
        judge.add_force(accel + GRAVITY_MPS2 * slope + 0.3 + noise.normal(0, 0.5), rate, STEP_S)
        if step % round(every_s / STEP_S) == 0:
            judge.add_speed(round(t * 1e9), sign * speed + noise.normal(0, 0.1))
    return judge


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("every_s", [0.05, 0.5, 1.0])
@pytest.mark.parametrize("grade", [0.0, 0.1])
def test_starts_and_stops_show_the_sign(sign: int, every_s: float, grade: float) -> None:
    assert [driven(sign=sign, seed=s, every_s=every_s, grade=grade).sign for s in range(5)] == [sign] * 5


def test_a_steady_speed_shows_nothing() -> None:
    assert {driven(sign=1, seed=s, accel_mps2=0.0, seconds=120.0, grade=0.1).sign for s in range(20)} == {0}


def test_what_is_forgotten_decides_no_longer() -> None:
    judge = driven(sign=-1, seed=1)
    judge.forget()
    assert judge.sign == 0


def test_speeds_or_forces_that_are_missing_decide_nothing() -> None:
    assert driven(sign=1, seed=1, every_s=4.0, seconds=200.0).sign == 0
    blind = TravelSign()
    for second in range(60):
        blind.add_speed(second * 10**9, math.sin(second))
    assert blind.sign == 0
