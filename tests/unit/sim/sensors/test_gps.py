import math
from dataclasses import replace

import numpy as np
import pytest

from sim.sensors.gps import CommonDrift
from sim.sensors.presets import Preset
from sim.sensors.rigs import Rig
from tests.unit.sim.sensor_rigs import (
    DGPS,
    SEED,
    check_deviation,
    errors,
    groups,
    noisy,
    perfect,
    rig,
    sampled,
    still,
    to_map,
    values,
)

N = 1000  # machines: independent draws


def test_receivers_state_the_variance_of_their_errors() -> None:
    preset = replace(DGPS, gps=replace(DGPS.gps, scale=1.5, outage_s=0.0))
    stated = values(rig(preset, only="gps"), "gps", 0.2)[0, 0, 3:]
    assert stated == pytest.approx([1.5**2 * (1.2**2 + 0.7**2) * k for k in (1, 1, (5 / 3) ** 2)])
    drift = errors(preset, "gps", 0.2, 4 * N)
    for axis in range(3):
        check_deviation(drift[..., axis], math.sqrt(stated[axis]), 4 * N)


@pytest.mark.parametrize(("machine", "site"), [(0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.9, 0.4), (1.0, 1.0)])
def test_drift_correlates_receivers_of_a_machine_and_of_the_site_by_their_shares(machine: float, site: float) -> None:
    preset = noisy("gps", drift_std_m=1.2, drift_time_s=0.2, machine_share=machine, site_share=site)
    two = [rig(preset, gps=(1, 2), only="gps")] * 2
    seconds = 400  # readings 0.2 s apart correlate by 1/e: half of them count
    fixes = to_map(groups(two, still(100 * seconds, 2))["gps"].values)
    off = fixes - [[0.8, 0, 3.35], [0.3, 0.6, 3.35]] * 2
    for a, b, expected in ((0, 1, machine), (2, 3, machine), (0, 2, site), (1, 2, site), (0, 3, site)):
        shares = (off[:, a] * off[:, b]).mean(axis=0) / (off**2).mean(axis=(0, 1))
        np.testing.assert_allclose(shares, expected, atol=5 / math.sqrt(seconds * 2.5), err_msg=f"{a} {b} seed {SEED}")


@pytest.mark.parametrize(("site", "others_change_nothing_else"), [(1.0, True), (0.0, False)])
def test_fully_shared_drift_is_one_whatever_the_rates_and_the_other_machines(
    site: float, others_change_nothing_else: bool
) -> None:
    def preset(rate_hz: int, time_s: float = 5.0) -> Preset:
        shares = {"machine_share": 1.0, "site_share": site}
        return noisy("gps", rate_hz=rate_hz, drift_std_m=1.0, drift_time_s=time_s, **shares)

    def tracks(rigs: list[Rig]) -> dict[int, np.ndarray]:
        span = sampled(rigs, still(200, len(rigs)))
        return {m: to_map(b.values[:, u]) for b in span.groups for u, m in enumerate(b.machines.tolist())}

    alone = tracks([rig(preset(5), only="gps")])
    mixed = tracks([rig(preset(5), only="gps"), rig(preset(10), only="gps"), rig(preset(5, 1.0), only="gps")])
    np.testing.assert_array_equal(mixed[0], alone[0])
    same = abs(mixed[1][1::2] - mixed[0]).max() < 1e-6
    assert same == others_change_nothing_else
    assert abs(mixed[2] - mixed[0]).max() > 0.1


def test_drift_is_the_same_in_pieces() -> None:
    def drift() -> CommonDrift:
        rngs = [np.random.default_rng(SEED + i) for i in range(2)]
        return CommonDrift(rngs, np.array([0, 1, 1]), np.array([5.0, 5.0, 20.0]))

    steps, pieces = np.arange(3, 301, 3), drift()
    np.testing.assert_allclose(
        np.concatenate([pieces.run(part) for part in np.split(steps, [7, 40])], 1), drift().run(steps)
    )


@pytest.mark.parametrize("rate_hz", [5, 10])
@pytest.mark.parametrize(("outage_s", "period_s"), [(1.0, 10.0), (3.0, 6.0), (0.0, 10.0)])
def test_receivers_are_silent_as_often_as_the_preset_says(rate_hz: int, outage_s: float, period_s: float) -> None:
    preset = noisy("gps", rate_hz=rate_hz, outage_s=outage_s, outage_period_s=period_s)
    valid = groups([rig(preset, gps=(1, 2, 3), only="gps")] * 50, still(3000, 50))["gps"].valid
    assert (~valid).mean(axis=0) == pytest.approx(outage_s / period_s, abs=1e-12)  # 30 s are whole periods


def test_receivers_of_one_machine_are_silent_in_turn() -> None:
    silent = ~groups([rig(DGPS, gps=(1, 2, 3), only="gps")], still(1000))["gps"].valid
    assert silent.sum(axis=0).tolist() == [5, 5, 5]
    assert silent.sum(axis=1).max() == 1


def test_silent_fixes_are_no_readings_but_their_errors_run_on() -> None:
    runs = []
    for outage_s in (0.0, 1.0):
        preset = replace(DGPS, gps=replace(DGPS.gps, outage_s=outage_s))
        runs.append(sampled([rig(preset, only="gps")], still(1000)).readings(0))
    assert [len(run) for run in runs] == [50, 45]
    assert set(runs[1]) < set(runs[0])


def test_antennas_sit_on_their_lever_arms() -> None:
    place = {"x_m": 100.0, "y_m": 50.0, "z_m": 6.0, "yaw_rad": math.pi / 2}
    one = rig(perfect(), gps=(1, 2), only="gps")
    fixes = to_map(groups([one], still(20, 1, **place))["gps"].values)[0]
    np.testing.assert_allclose(fixes, [[100, 50.8, 9.35], [99.4, 50.3, 9.35]], atol=1e-5)
    nose_up = to_map(groups([one], still(20, 1, **place, pitch_rad=-0.2))["gps"].values)[0]
    np.testing.assert_allclose(nose_up[0, 1], 50 + 0.8 * math.cos(0.2) - 3.35 * math.sin(0.2), atol=1e-5)
    left_up = to_map(groups([one], still(20, 1, **place, roll_rad=0.2))["gps"].values)[0]
    np.testing.assert_allclose(left_up[0, 0], 100 + 3.35 * math.sin(0.2), atol=1e-5)


def test_velocities_are_those_of_antennas_also_on_a_turning_machine() -> None:
    """2 m/s north, turning left by 0.5 rad/s: front antennas also go west, left ones are slower."""
    preset = noisy("gps", velocity_std_mps=0.05)
    turning = {"speed_mps": 2.0, "yaw_rad": math.pi / 2, "rates_radps": (0.0, 0.0, 0.5)}
    motion = groups([rig(preset, gps=(1, 2), only="gps_velocity", doppler=True)], still(40_000, **turning))[
        "gps_velocity"
    ]
    expected = [(-0.5 * 0.8, 2.0), (-0.5 * 0.3, 2.0 - 0.5 * 0.6)]
    np.testing.assert_allclose(motion.values[..., :2].mean(axis=0), expected, atol=0.004, err_msg=f"seed {SEED}")
    check_deviation(motion.values[:, 0, 0] - expected[0][0], 0.05, len(motion.values))
    assert (motion.values[..., 2:] == 0.05**2).all()
