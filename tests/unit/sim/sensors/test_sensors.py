import math
from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import pytest

from protocol.machine.readings import Reading
from sim.sensors.rigs import Faults, Rig
from sim.sensors.sensors import Sensors
from sim.state import FleetState
from tests.unit.sim.sensor_rigs import (
    DGPS,
    PROJECTION,
    SEED,
    WIDTHS,
    check_correlation,
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

N = 300
STEPS = 600
FULL = rig(DGPS, gps=(1, 2), imu=(1, 3), attitude=(3,), payload=True)


def moving(k: int, n: int) -> FleetState:
    """Arbitrary states, independent of the number of machines."""
    rng = np.random.default_rng(SEED)
    whole = {f.name: rng.standard_normal((k, 10, WIDTHS.get(f.name, 1))) for f in fields(FleetState)}
    cut = {name: values[:, :n] if name in WIDTHS else values[:, :n, 0] for name, values in whole.items()}
    return FleetState(**cut)


def cut(states: FleetState, part: slice) -> FleetState:
    return FleetState(*(getattr(states, f.name)[part] for f in fields(FleetState)))


def run(rigs: Sequence[Rig], seed: int = SEED, span: int = 5) -> list[list[Reading]]:
    """Each machine's readings, some steps at a time."""
    sensors, states = Sensors(rigs, seed, PROJECTION), moving(STEPS, len(rigs))
    readings: list[list[Reading]] = [[] for _ in rigs]
    for start in range(0, STEPS, span):
        part = slice(start, min(start + span, STEPS))
        steps = np.arange(part.start, part.stop) + 1
        seen = sensors.sample(steps, steps * 10_000_000, cut(states, part))
        for i, machine_readings in enumerate(readings):
            machine_readings += seen.readings(i)
    return readings


BASE = run([FULL] * 3)


# --- all of them -----------------------------------------------------------------------------------------------------


def test_same_seed_repeats_every_reading() -> None:
    assert run([FULL] * 3) == BASE
    assert run([FULL] * 3, seed=SEED + 1) != BASE


@pytest.mark.parametrize("count", [1, 10])
def test_readings_do_not_depend_on_other_machines(count: int) -> None:
    other = rig(noisy("gps", rate_hz=10, drift_std_m=9.0), gps=(1, 2, 3), imu=(2,))
    readings = run([FULL, *[other, FULL] * 5][:count])
    for i in range(0, min(3, count), 2):
        assert readings[i] == BASE[i]


def test_readings_do_not_depend_on_other_sensors() -> None:
    without = replace(DGPS, gps=replace(DGPS.gps, outage_s=0.0))  # outages are staggered by the number of receivers
    many = run([rig(without, gps=(1, 2, 3), imu=(1, 2, 3, 4), attitude=(1, 2, 3), payload=True)])[0]
    few = run([rig(without, gps=(2,), imu=(3,), attitude=(2,), payload=True)])[0]
    names = {reading.sensor for reading in few}
    assert names == {"gps-2", "imu-3", "attitude-2", "torque", "wheels", "articulation", "payload"}
    assert [reading for reading in many if reading.sensor in names] == few


@pytest.mark.parametrize("span", [1, 600])
def test_readings_do_not_depend_on_how_many_steps_are_sampled_at_a_time(span: int) -> None:
    assert run([FULL] * 3, span=span) == BASE


def test_readings_come_in_the_order_of_stamps_and_of_the_machines_sensors() -> None:
    order = [sensor.name for sensor in FULL.machine.sensors]
    keys = [(reading.stamp_ns, order.index(reading.sensor)) for reading in BASE[1]]
    assert keys == sorted(keys)


# --- errors ----------------------------------------------------------------------------------------------------------

# Sensor kind, rates, errors, and each column's standard deviation.
WHITE = [
    ("gps", (5, 10), {"white_std_m": 0.7}, (0.7, 0.7, 0.7 * 5 / 3)),
    ("imu", (100, 50), {"gyro_white_degps": 0.1, "force_white_mps2": 0.08}, (*np.radians([0.1] * 3), *[0.08] * 3)),
    ("attitude", (50, 20), {"tilt_white_deg": 0.1, "heading_white_deg": 0.3}, np.radians([0.1, 0.1, 0.3])),
    ("torque", (50, 20), {"white_nm": 600.0}, (600.0,)),
    ("articulation", (20, 50), {"white_deg": 0.2}, np.radians([0.2])),
    ("payload", (1, 5), {"white_kg": 50.0}, (50.0,)),
]
SLOW = [
    ("gps", (5, 10), {"drift_std_m": 1.2}, (1.2, 1.2, 2.0)),
    ("imu", (100, 50), {"gyro_drift_degps": 0.2, "force_drift_mps2": 0.01}, (*np.radians([0.2] * 3), *[0.01] * 3)),
    ("attitude", (50, 20), {"tilt_drift_deg": 0.4, "heading_drift_deg": 1.0}, np.radians([0.4, 0.4, 1.0])),
    ("torque", (50, 20), {"correlated_nm": 300.0}, (300.0,)),
]
ONCE = [
    ("imu", {"gyro_turn_on_degps": 0.05, "force_turn_on_mps2": 0.03}, (*np.radians([0.05] * 3), *[0.03] * 3)),
    ("attitude", {"heading_offset_deg": 1.5}, np.radians([0, 0, 1.5])),
    ("torque", {"scale": 0.03}, (300.0,)),
    ("articulation", {"zero_deg": 0.3}, np.radians([0.3])),
    ("payload", {"scale": 0.02}, (80.0,)),
]


@pytest.mark.parametrize(("kind", "rates_hz", "given", "stds"), WHITE)
def test_white_noise_is_white(kind: str, rates_hz: tuple[int, int], given: dict, stds: Sequence[float]) -> None:
    for rate_hz in rates_hz:
        seen = errors(noisy(kind, rate_hz=rate_hz, **given), kind, 20 / rate_hz, N)
        assert seen.shape == (20, N, len(stds))
        for column, std in enumerate(stds):
            check_deviation(seen[..., column], std, seen[..., column].size)
            check_correlation(seen[..., column], 1, 0.0, seen[..., column].size)


@pytest.mark.parametrize(("kind", "rates_hz", "given", "stds"), SLOW)
def test_drift_has_its_deviation_and_time(kind: str, rates_hz: tuple[int, int], given: dict, stds: list) -> None:
    time = {"correlation_s" if kind == "torque" else "drift_time_s": 1.0}
    for rate_hz in rates_hz:
        seen = errors(noisy(kind, rate_hz=rate_hz, **given, **time), kind, 3.0, N)
        for column, std in enumerate(stds):
            check_deviation(seen[..., column], std, N)
            check_correlation(seen[..., column], rate_hz, math.exp(-1), N)


@pytest.mark.parametrize(("kind", "given", "stds"), ONCE)
def test_zeros_and_scales_are_drawn_once(kind: str, given: dict, stds: Sequence[float]) -> None:
    seen = errors(noisy(kind, rate_hz=10, **given), kind, 0.5, 2 * N)
    np.testing.assert_allclose(seen, np.broadcast_to(seen[0], seen.shape), atol=1e-12)
    for column, std in enumerate(stds):
        check_deviation(seen[0, :, column], std, 2 * N)


# --- drive train -----------------------------------------------------------------------------------------------------


def test_encoder_counts_whole_ticks_of_both_wheels() -> None:
    turns = np.repeat([[0.0, 0.01], [math.pi, 6.2], [2 * math.pi + 1e-9, 7.0], [-0.01, 0.0]], 5, axis=0)[:, None]
    ticks = groups([rig(DGPS, only="encoder")], still(20, 1, wheel_rad=turns))["encoder"].values[:, 0]
    assert ticks.tolist() == [[0, 0], [50, 98], [100, 111], [-1, 0]]
    fine = groups([rig(noisy("encoder", ticks_per_rev=1000), only="encoder")], still(20, 1, wheel_rad=turns))
    assert fine["encoder"].values[:, 0].tolist() == [[0, 1], [500, 986], [1000, 1114], [-2, 0]]


def test_payload_follows_what_is_carried_and_is_never_negative() -> None:
    carried = np.repeat([0.0, 1500.0, 4000.0], 100)[:, None]
    quiet, loud = (rig(noisy("payload", white_kg=kg), only="payload", payload=True) for kg in (0.0, 50.0))
    assert groups([quiet], still(300, payload_kg=carried))["payload"].values.ravel().tolist() == [0.0, 1500.0, 4000.0]
    empty = values(loud, "payload", 2.0, N)
    assert empty.min() == 0.0
    assert 0.4 < (empty > 0).mean() < 0.6


# --- faults ----------------------------------------------------------------------------------------------------------


def faulty(**faults: object) -> list[Rig]:
    """A machine with a fault from 2 s on, and one without."""
    return [rig(perfect(), faults=Faults(from_s=2.0, **faults)), rig(perfect())]  # type: ignore[arg-type]


def test_torque_scale_counts_from_its_time_on() -> None:
    group = groups(faulty(torque_scale=1.6), still(400, 2, torque_nm=1e4))["torque"]
    early = np.arange(1, 201) * 0.02 < 2.0
    np.testing.assert_allclose(group.values[early, :, 0], 1e4)
    np.testing.assert_allclose(group.values[~early, 0, 0], 1.6e4)
    np.testing.assert_allclose(group.values[~early, 1, 0], 1e4)


def test_antennas_are_off_from_their_time_on() -> None:
    group = groups(faulty(antenna_off_m=(0.0, 3.0, 0.5)), still(400, 2, yaw_rad=math.pi / 2))["gps"]
    fixes, early = to_map(group.values), np.arange(1, 21) * 0.2 < 2.0 - 1e-9
    configured = np.array([0.0, 0.8, 3.35])
    np.testing.assert_allclose(fixes[early], np.broadcast_to(configured, fixes[early].shape), atol=1e-5)
    np.testing.assert_allclose(fixes[~early, 0] - configured, [[-3.0, 0.0, 0.5]] * 11, atol=1e-5)
    np.testing.assert_allclose(fixes[~early, 1] - configured, 0.0, atol=1e-5)


@pytest.mark.parametrize("clock_off_s", [0.25, -0.25])
def test_clock_is_off_from_its_time_on(clock_off_s: float) -> None:
    span = sampled(faulty(clock_off_s=clock_off_s), still(400, 2))
    for group in span.groups:
        wrong, right = group.stamps_ns.T
        late = right >= 2_000_000_000
        assert (wrong - right).tolist() == (late * round(clock_off_s * 1e9)).tolist()
    assert len(span.readings(0)) == len(span.readings(1))
    stamps = [reading.stamp_ns for reading in span.readings(0)]
    assert stamps == sorted(stamps)


def test_faults_change_nothing_before_their_time() -> None:
    faults = Faults(from_s=STEPS / 100 - 1, torque_scale=2.0, antenna_off_m=(1.0, 1.0, 1.0), clock_off_s=5.0)
    readings = run([replace(FULL, faults=faults)])[0]
    before = [reading for reading in BASE[0] if reading.stamp_ns < (STEPS - 100) * 10_000_000]
    assert readings[: len(before)] == before
    assert readings[len(before)] not in BASE[0]
