import math
from dataclasses import replace

import numpy as np
import pytest

from sim.sensors.presets import load_preset
from tests.unit.sim.sensor_rigs import SEED, check_deviation, errors, noisy, perfect, rig, values

N = 40


@pytest.mark.parametrize(("name", "mps2"), [("shaking_1", 1.0), ("shaking_2", 2.0), ("shaking_5", 5.0)])
def test_presets_shake_by_what_their_names_say(name: str, mps2: float) -> None:
    imu = load_preset(name).imu
    total = math.hypot(imu.shake_mps2, imu.wheel_mps2, imu.engine_mps2)
    assert total == pytest.approx(mps2, abs=0.02 * mps2)


def test_a_body_that_shakes_goes_nowhere() -> None:
    """Means over ten readings are far below white noise's third of one reading."""
    seen = errors(
        noisy("imu", shake_mps2=2.0, degps_per_mps2=4.0, vibration_speed_mps=1.0), "imu", 5.0, N, speed_mps=4.0
    )
    for columns, std in ((slice(3, 6), 2.0), (slice(0, 3), math.radians(8.0))):
        check_deviation(seen[..., columns], std, 100 * N)
        means = seen[..., columns].reshape(50, 10, N, 3).mean(axis=1)
        assert means.std() < 0.25 * std, f"seed {SEED}"


@pytest.mark.parametrize(("part", "hz"), [("wheel_mps2", 20 * 4.0 / (2 * math.pi * 0.75)), ("engine_mps2", 30.0)])
def test_wheels_and_engine_shake_at_their_frequencies(part: str, hz: float) -> None:
    time_s = 0.01 * np.arange(1, 401)
    wheel_rad = np.broadcast_to((4.0 / 0.75 * time_s)[:, None, None], (400, 1, 2))
    preset = noisy("imu", **{part: 1.0}, vibration_speed_mps=1.0)
    force = errors(preset, "imu", 4.0, 1, speed_mps=4.0, wheel_rad=wheel_rad)[:, 0, 3]
    assert force.std() == pytest.approx(1.0, rel=0.05)
    assert np.fft.rfftfreq(400, 0.01)[np.abs(np.fft.rfft(force)).argmax()] == pytest.approx(hz, abs=0.25)


def test_a_machine_that_stands_shakes_with_its_engine_alone() -> None:
    imu = {"shake_mps2": 1.0, "wheel_mps2": 1.0, "engine_mps2": 0.5, "vibration_speed_mps": 1.0}
    assert errors(noisy("imu", **imu), "imu", 2.0, N)[..., 3:].std() == pytest.approx(0.5, rel=0.05)


def test_imus_of_one_machine_shake_alike_and_its_other_errors_stay_as_they_are() -> None:
    preset = noisy("imu", shake_mps2=1.0)
    both = values(rig(preset, imu=(3, 4), only="imu"), "imu", 0.5, speed_mps=4.0)
    np.testing.assert_allclose(both[:, 0, 3], -both[:, 1, 4], atol=1e-9)  # IMU 4 is turned by 90 degrees
    quiet, shaking = (
        values(rig(replace(perfect(), imu=replace(load_preset("dgps").imu, shake_mps2=mps2)), only="imu"), "imu", 0.5)
        for mps2 in (0.0, 1.0)
    )
    np.testing.assert_array_equal(quiet, shaking)  # it stands
