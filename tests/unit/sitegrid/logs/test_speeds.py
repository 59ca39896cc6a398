"""Speeds by fixes and by wheels: offsets of clocks, scales, wheels that stand."""

import math

import numpy as np
import pytest

from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Encoder, Odometry
from sitegrid.logs.speeds import compare_speeds, wheel_distance

TIMES = np.arange(0.0, 120.0, 0.1)


def driven(seed: int = 3) -> np.ndarray:
    """The distance of a drive that changes its speed every 4 s."""
    speeds = np.repeat(np.random.default_rng(seed).choice([0.0, 1.0, 3.0, 5.0], len(TIMES) // 40), 40)
    return np.cumsum(speeds) * 0.1


def fixes(metres: np.ndarray, noise_m: float = 0.3) -> np.ndarray:
    return np.stack([metres, 0 * metres], axis=1) + np.random.default_rng(5).normal(0, noise_m, (len(metres), 2))


@pytest.mark.parametrize("lag_s", [-25.0, -1.0, 0.0, 1.0, 18.0, 30.0])
def test_the_offset_of_two_clocks_shows_in_the_speeds(lag_s: float) -> None:
    agreement = compare_speeds((TIMES + lag_s, fixes(driven())), (TIMES, driven()))
    assert agreement
    assert agreement.lag_s == pytest.approx(lag_s, abs=0.3)


def test_a_steady_drive_shows_no_offset() -> None:
    agreement = compare_speeds((TIMES, fixes(3.0 * TIMES)), (TIMES, 3.0 * TIMES))
    assert agreement
    assert agreement.lag_s is None
    assert agreement.wheel_share == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("scale", [0.5, 1.0, 3.6])
def test_the_scale_of_wheels_is_that_of_their_distance(scale: float) -> None:
    agreement = compare_speeds((TIMES, fixes(driven())), (TIMES, scale * driven()))
    assert agreement
    assert agreement.wheel_share == pytest.approx(scale, rel=0.05)
    assert agreement.stuck_s < 3


def test_wheels_that_stand_while_the_machine_moves_are_timed() -> None:
    stuck = np.minimum(4.0 * TIMES, 4.0 * 50.0)
    agreement = compare_speeds((TIMES, fixes(4.0 * TIMES)), (TIMES, stuck))
    assert agreement
    assert agreement.stuck_s == pytest.approx(70.0, abs=4.0)


def test_a_machine_that_stands_and_a_short_log_show_nothing() -> None:
    agreement = compare_speeds((TIMES, fixes(0 * TIMES, noise_m=0.05)), (TIMES, 0 * TIMES))
    assert agreement
    assert math.isnan(agreement.wheel_share)
    assert agreement.stuck_s == 0
    assert compare_speeds((TIMES[:40], fixes(driven()[:40])), (TIMES[:40], driven()[:40])) is None


def test_ticks_and_speeds_are_the_same_way() -> None:
    """Also backwards: it is the way, not the place."""
    encoder = SensorConfig("ticks", "encoder", ticks_per_rev=100)
    machine = MachineConfig("m", wheel_radius_m=0.5, sensors=(encoder,))
    per_tick_m = 2 * math.pi * 0.5 / 100
    ticks = [Encoder("ticks", 10**9 * i, t, t) for i, t in enumerate([0.0, 100.0, 50.0])]
    speeds = [
        Odometry("speed", 10**9 * i, v, 0.0, 0.0) for i, v in enumerate([0.0, 100 * per_tick_m, -50 * per_tick_m])
    ]
    for readings in (ticks, speeds):
        seconds, metres = wheel_distance(readings, machine)
        assert seconds.tolist() == [0.0, 1.0, 2.0]
        assert metres == pytest.approx([0.0, 100 * per_tick_m, 150 * per_tick_m])
