import math
from dataclasses import fields, replace

import numpy as np
import pytest

from protocol.machine import Mount, SensorConfig
from protocol.readings import Encoder, Gps, Imu
from protocol.site import Projection
from sim import paper_site
from sim.frames import body_rates, map_from_base, up_in_base
from sim.machines import IMU_MOUNTS, loader
from sim.noise import GaussMarkov, generators
from sim.sensors import (
    ArticulationNoise,
    ArticulationSensor,
    GpsNoise,
    GpsReceiver,
    ImuNoise,
    InertialUnit,
    Sensor,
    TorqueMeter,
    TorqueNoise,
    WheelEncoder,
)
from sim.world import FleetState

SEED = 7
PROJECTION = Projection(paper_site.site("paper"))
NOISE = GpsNoise(1.2, 5.0, 0.7, 1.0, 10.0, 0.0)
SILENT_NOISE = GpsNoise(0.0, 60.0, 0.0, 0.0, 10.0, 0.0)
NO_IMU_NOISE = ImuNoise(**{f.name: 0.0 for f in fields(ImuNoise)} | {"vibration_speed_mps": 1.0, "drift_time_s": 1.0})


def at_rest(k: int) -> FleetState:
    """States (k, ...) of one machine at the origin."""
    widths = {"rates_radps": 3, "rates_dot_radps2": 3, "force_mps2": 3, "wheel_radps": 2, "wheel_rad": 2}
    arrays = [np.zeros((k, widths[f.name]) if f.name in widths else k) for f in fields(FleetState)]
    state = FleetState(*arrays)
    state.force_mps2[:, 2] = 9.8
    return state


def read(sensor: Sensor, states: FleetState, every: int = 1) -> list:
    steps = np.arange(1, len(states.x_m) + 1) * every
    return sensor.sample(steps, steps * 10_000_000, states)


def rng(stream: str = "gps-1", seed: int = SEED) -> np.random.Generator:
    return generators(seed, 0)[stream]


def gps_errors(noise: GpsNoise, seconds: float, seed: int = SEED) -> tuple[np.ndarray, list[Gps]]:
    fixes = read(
        GpsReceiver(SensorConfig("gps-1", "gps"), noise, PROJECTION, rng(seed=seed)), at_rest(int(seconds * 5)), 20
    )
    return np.array([PROJECTION.to_map(f.lat_deg, f.lon_deg, f.height_m) for f in fixes]), fixes


def correlation(series: np.ndarray, lag: int) -> float:
    return float((series[lag:] * series[:-lag]).mean() / (series**2).mean())


# --- noise -----------------------------------------------------------------------------------------------------------


def test_gauss_markov_has_its_deviation_and_correlation_time() -> None:
    noise = np.random.default_rng(SEED)
    errors = GaussMarkov(np.array([2.0]), 1.0, 0.1, noise).run(noise.standard_normal((100_000, 1)))[:, 0]
    assert errors.std() == pytest.approx(2.0, rel=0.03), SEED
    assert correlation(errors, 10) == pytest.approx(math.exp(-1), abs=0.03), SEED


def test_gauss_markov_starts_stationary() -> None:
    noise = np.random.default_rng(SEED)
    first = GaussMarkov(np.full(20_000, 3.0), 60.0, 0.1, noise).run(noise.standard_normal((1, 20_000)))
    assert first.std() == pytest.approx(3.0, rel=0.03), SEED


def test_gauss_markov_does_not_depend_on_the_length_of_runs() -> None:
    white = np.random.default_rng(SEED).standard_normal((50, 3))
    whole, parts = (GaussMarkov(np.ones(3), 1.0, 0.1, np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(
        whole.run(white.copy()), np.vstack([parts.run(p.copy()) for p in np.split(white, 10)])
    )


# --- GPS -------------------------------------------------------------------------------------------------------------


def test_gps_error_has_the_variance_that_the_receiver_states() -> None:
    errors, fixes = gps_errors(NOISE, 3600)
    stated = [fixes[0].var_e_m2, fixes[0].var_n_m2, fixes[0].var_u_m2]
    assert stated == pytest.approx([1.2**2 + 0.7**2] * 2 + [2.0**2 + (0.7 * 5 / 3) ** 2])
    np.testing.assert_allclose(errors.var(axis=0), stated, rtol=0.15, err_msg=f"seed {SEED}")


def test_gps_error_is_slow_and_white() -> None:
    errors, _ = gps_errors(replace(NOISE, outage_s=0.0), 3600)
    slow = 1.2**2 / (1.2**2 + 0.7**2)
    assert correlation(errors[:, 0], 1) == pytest.approx(slow * math.exp(-0.2 / 5), abs=0.06), SEED
    assert correlation(errors[:, 0], 25) == pytest.approx(slow * math.exp(-1), abs=0.1), SEED


def test_gps_is_silent_one_second_in_ten() -> None:
    _, fixes = gps_errors(NOISE, 1000)
    assert len(fixes) == 4500
    missing = sorted(set(range(200, 1_000_001, 200)) - {f.stamp_ns // 1_000_000 for f in fixes})
    assert [m % 10_000 // 1000 for m in missing] == [0] * 500


def test_gps_drift_runs_on_while_the_receiver_is_silent() -> None:
    heard, _ = gps_errors(replace(NOISE, outage_s=0.0), 20)
    gaps, _ = gps_errors(NOISE, 20)
    np.testing.assert_allclose(gaps, heard[[i for i in range(100) if ((i + 1) * 0.2 + 1e-9) % 10 >= 1]], atol=1e-9)


def test_gps_antenna_sits_on_its_lever_arm() -> None:
    receiver = GpsReceiver(SensorConfig("gps-1", "gps", Mount((0.8, 0.3, 3.35))), SILENT_NOISE, PROJECTION, rng())
    states = at_rest(1)
    states.x_m[:], states.y_m[:], states.z_m[:], states.yaw_rad[:] = 100.0, 50.0, 6.0, math.pi / 2
    (fix,) = read(receiver, states, 20)
    antenna = PROJECTION.to_map(fix.lat_deg, fix.lon_deg, fix.height_m)
    assert antenna == pytest.approx((99.7, 50.8, 9.35), abs=1e-5)
    states.pitch_rad[:] = -0.2  # nose up: the antenna leans back
    (fix,) = read(receiver, states, 20)
    assert PROJECTION.to_map(fix.lat_deg, fix.lon_deg, fix.height_m)[1] < 50.8 - 0.6


# --- IMU -------------------------------------------------------------------------------------------------------------


def test_imu_without_noise_reads_force_and_rates_in_its_own_frame() -> None:
    states = at_rest(1)
    states.rates_radps[:] = [0.1, 0.2, 0.3]
    for mount, signs in zip(IMU_MOUNTS, ([1, 2, 3], [2, -1, 3], [1, -2, -3]), strict=True):
        config = SensorConfig("imu-1", "imu", replace(mount, xyz_m=(0.0, 0.0, 0.0)))
        (reading,) = read(InertialUnit(config, NO_IMU_NOISE, rng("imu-1")), states)
        assert [reading.gyro_x_radps, reading.gyro_y_radps, reading.gyro_z_radps] == pytest.approx(
            [0.1 * s for s in signs]
        )
        assert reading.force_z_mps2 == pytest.approx(math.copysign(9.8, signs[2]))


def test_imu_off_the_frames_origin_feels_the_rotation() -> None:
    states = at_rest(1)
    states.rates_radps[:, 2] = 0.5
    states.rates_dot_radps2[:, 2] = 0.2
    config = SensorConfig("imu-1", "imu", Mount((2.0, 0.0, 1.0)))
    (reading,) = read(InertialUnit(config, NO_IMU_NOISE, rng("imu-1")), states)
    assert reading.force_x_mps2 == pytest.approx(-(0.5**2) * 2.0)
    assert reading.force_y_mps2 == pytest.approx(0.2 * 2.0)


def imu_values(noise: ImuNoise, states: FleetState, seed: int = SEED) -> np.ndarray:
    readings: list[Imu] = read(InertialUnit(SensorConfig("imu-1", "imu"), noise, rng("imu-1", seed)), states)
    return np.array([[getattr(r, name) for name in Imu.limits] for r in readings])


def test_imu_noise_has_its_parameters() -> None:
    noise = ImuNoise(drift_time_s=1e6)
    values = imu_values(noise, at_rest(20_000))
    np.testing.assert_allclose(values[:, :3].std(axis=0), np.radians(0.1), rtol=0.03, err_msg=f"seed {SEED}")
    np.testing.assert_allclose(values[:, 3:].std(axis=0), 0.08, rtol=0.03, err_msg=f"seed {SEED}")
    driving = at_rest(20_000)
    driving.speed_mps[:] = 4.0
    shaken = imu_values(noise, driving)[:, 3:].std(axis=0)
    np.testing.assert_allclose(shaken, math.hypot(0.08, 0.3), rtol=0.03, err_msg=f"seed {SEED}")


@pytest.mark.parametrize(
    ("changes", "gyro", "force"),
    [
        ({"gyro_turn_on_radps": 1e-3, "force_turn_on_mps2": 0.03}, 1e-3, 0.03),
        ({"gyro_drift_radps": 1e-3, "force_drift_mps2": 0.02, "drift_time_s": 300.0}, 1e-3, 0.02),
    ],
)
def test_imu_zero_errors_spread_over_seeds_as_stated(changes: dict, gyro: float, force: float) -> None:
    truth = np.array([0, 0, 0, 0, 0, 9.8])
    noise = replace(NO_IMU_NOISE, **changes)
    errors = np.array([imu_values(noise, at_rest(1), seed)[0] - truth for seed in range(300)])
    np.testing.assert_allclose(errors[:, :3].std(), gyro, rtol=0.12)
    np.testing.assert_allclose(errors[:, 3:].std(), force, rtol=0.12)


def test_imu_scale_and_mounting_errors() -> None:
    scaled = [imu_values(replace(NO_IMU_NOISE, scale=0.002), at_rest(1), s)[0, 5] / 9.8 - 1 for s in range(300)]
    assert np.std(scaled) == pytest.approx(0.002, rel=0.15)
    tilted = [imu_values(replace(NO_IMU_NOISE, mounting_rad=0.002), at_rest(1), s)[0, 3:5] / 9.8 for s in range(300)]
    assert np.std(tilted) == pytest.approx(0.002, rel=0.15)


# --- the others ------------------------------------------------------------------------------------------------------


def test_encoder_counts_whole_ticks_of_both_wheels() -> None:
    states = at_rest(4)
    states.wheel_rad[:] = np.array([[0.0, 0.01], [math.pi, 6.2], [2 * math.pi + 1e-9, 7.0], [-0.01, 0.0]])
    counts: list[Encoder] = read(WheelEncoder(SensorConfig("wheels", "encoder")), states, 5)
    assert [(c.left_ticks, c.right_ticks) for c in counts] == [(0, 0), (50, 98), (100, 111), (-1, 0)]


def test_torque_noise_is_white_and_correlated_with_a_scale_error() -> None:
    states = at_rest(100_000)
    values = np.array(
        [
            r.torque_nm
            for r in read(TorqueMeter(SensorConfig("torque", "torque"), TorqueNoise(), rng("torque")), states, 2)
        ]
    )
    assert values.std() == pytest.approx(math.hypot(600, 300), rel=0.05), SEED
    slow = 300**2 / (600**2 + 300**2)
    assert correlation(values, 50) == pytest.approx(slow * math.exp(-1), abs=0.03), SEED
    states = at_rest(1)
    states.torque_nm[:] = 1e6
    noise = TorqueNoise(white_nm=0.0, correlated_nm=0.0)
    config = SensorConfig("torque", "torque")
    scales = [read(TorqueMeter(config, noise, rng("torque", s)), states, 2)[0].torque_nm / 1e6 for s in range(300)]
    assert np.std(scales) == pytest.approx(0.03, rel=0.15)


def test_articulation_has_noise_and_a_zero_error() -> None:
    config = SensorConfig("articulation", "articulation")
    states = at_rest(5000)
    states.articulation_rad[:] = 0.3
    means = []
    for seed in range(20):
        values = np.array(
            [
                r.angle_rad
                for r in read(ArticulationSensor(config, ArticulationNoise(), rng("articulation", seed)), states, 5)
            ]
        )
        assert values.std() == pytest.approx(math.radians(0.2), rel=0.05), seed
        means.append(values.mean())
    assert np.mean(means) == pytest.approx(0.3, abs=0.004)
    assert math.radians(0.15) < np.std(means) < math.radians(0.45)


def test_loader_has_the_sensors_asked_for_fast_ones_first() -> None:
    names = [s.name for s in loader("a", 2, 1).sensors]
    assert names == ["imu-1", "torque", "wheels", "articulation", "gps-1", "gps-2"]
    assert [s.kind for s in loader("a", 0, 3).sensors][:3] == ["imu"] * 3
    mounts = [s.mount.xyz_m for s in loader("a", 3, 1).sensors[-3:]]
    assert len(set(mounts)) == 3
    assert all(z > 3 for _, _, z in mounts)


def test_generators_differ_between_machines_and_sensors() -> None:
    draws = {(m, name): g.random() for m in range(3) for name, g in generators(SEED, m).items()}
    assert len(set(draws.values())) == len(draws)
    spawned = np.random.SeedSequence(SEED).spawn(3)[2].spawn(1)[0]
    assert draws[2, "body"] == np.random.default_rng(spawned).random()


# --- frames ----------------------------------------------------------------------------------------------------------


def test_frames_agree_with_the_mounts_rotation() -> None:
    roll, pitch, yaw = 0.1, -0.3, 2.0
    matrix = Mount(rpy_deg=tuple(np.degrees([roll, pitch, yaw]))).base_from_sensor()
    one = (np.array([yaw]), np.array([pitch]), np.array([roll]))
    vector = np.array([0.3, -0.5, 0.9])
    np.testing.assert_allclose(map_from_base(vector, *one)[0], matrix @ vector)
    np.testing.assert_allclose(up_in_base(one[1], one[2])[0], matrix.T @ [0, 0, 1])


def test_body_rates_are_those_of_the_turning_frame() -> None:
    def matrix(t: float) -> np.ndarray:
        return Mount(rpy_deg=tuple(np.degrees([0.1 + 0.3 * t, -0.2 + 0.1 * t, 1 - 0.5 * t]))).base_from_sensor()

    h = 1e-6
    turn = matrix(0).T @ (matrix(h) - matrix(-h)) / (2 * h)
    one = [np.array([v]) for v in (-0.5, 0.1, 0.3, -0.2, 0.1)]
    np.testing.assert_allclose(body_rates(*one)[0], [turn[2, 1], turn[0, 2], turn[1, 0]], atol=1e-8)
