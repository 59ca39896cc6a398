import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from agents_drives import (
    PROJECTION,
    S_BEND,
    START_NS,
    Drive,
    Leg,
    changed_sensor,
    drive,
    fix,
    machine,
    simulated,
)

from agents.localisation.localiser import LocalisationConfig, Localiser, PoseBelief
from agents.localisation.model import GYRO_BIAS, ModelConfig
from protocol.machine import MachineConfig, Mount
from protocol.readings import Gps, Imu, Reading
from protocol.site import Projection

NO_SLIP = ModelConfig(slip=1e-9)  # made-up drives have none


def localiser(of: MachineConfig, **options: Any) -> Localiser:
    return Localiser(of, PROJECTION, LocalisationConfig(**options), NO_SLIP)


def run(found: Localiser, of: MachineConfig, readings: list[Reading]) -> list[PoseBelief]:
    beliefs: list[PoseBelief] = []
    for reading in readings:
        sensor = of.sensor(reading.sensor)
        assert sensor
        beliefs += found.update(reading, sensor)
    return beliefs


def position_errors(beliefs: list[PoseBelief], made: Drive) -> list[float]:
    return [math.dist((b.x_m, b.y_m), made.at(b.stamp_ns)[:2]) for b in beliefs]


def moved(reading: Reading, north_m: float) -> Reading:
    """A fix that lies further north."""
    assert isinstance(reading, Gps)
    return replace(reading, lat_deg=reading.lat_deg + north_m / 111_200)


def after(reading: Reading, seconds: float) -> bool:
    return reading.stamp_ns > START_NS + seconds * 1e9


@pytest.mark.parametrize("receivers", [1, 3])
def test_noiseless_readings_give_a_small_error(receivers: int) -> None:
    of = machine(receivers=receivers)
    made = drive(S_BEND, of)
    found = localiser(of)
    beliefs = run(found, of, made.readings)
    assert found.is_aligned
    assert max(position_errors(beliefs, made)) < 0.3
    heading_errors = [abs(math.remainder(b.heading_rad - made.at(b.stamp_ns)[2], math.tau)) for b in beliefs]
    assert max(heading_errors) < 0.05
    assert all(-math.pi <= b.heading_rad <= math.pi for b in beliefs)


def test_antenna_far_from_the_rear_axle_is_no_trouble() -> None:
    of = changed_sensor(machine(), "gps-1", mount=Mount((4.0, 6.0, 3.0)))
    made = drive([Leg(4, 0.5, 0.2), Leg(4, 0.0, 0.25), Leg(8)], of)
    errors = position_errors(run(localiser(of), of, made.readings), made)
    assert errors[0] < 0.2  # the alignment alone, found in a bend
    assert max(errors) < 0.6


def test_nothing_that_was_driven_before_the_alignment_is_lost() -> None:
    of = machine()
    made = drive([Leg(3), *S_BEND], of)
    found = localiser(of)
    aligned_ns = next(r.stamp_ns for r in made.readings if run(found, of, [r]) and found.is_aligned)
    beliefs = run(localiser(of), of, made.readings)
    assert aligned_ns > START_NS + 8 * 10**9
    assert beliefs[0].stamp_ns <= START_NS + 200_000_000
    stamps = [b.stamp_ns for b in beliefs]
    assert stamps == sorted(stamps)
    assert max(np.diff(stamps)) <= 200_000_000


def test_no_pose_before_the_heading_is_known() -> None:
    of = machine()
    found = localiser(of)
    assert run(found, of, drive([Leg(60)], of).readings) == []  # a parked machine
    straight = drive([Leg(4, 0.5), Leg(2)], of, without=("gps-1",))
    assert run(localiser(of), of, straight.readings) == []
    assert not found.is_aligned


def test_reverse_driving_from_the_start_is_aligned_too() -> None:
    of = machine()
    made = drive([Leg(4, -0.5), Leg(5), Leg(4, 0, 0.2), Leg(4)], of)
    assert max(position_errors(run(localiser(of), of, made.readings), made)) < 0.3


def test_outlier_is_gated_and_counted() -> None:
    of = machine()
    made = drive(S_BEND, of)
    outliers = [r.stamp_ns for r in made.readings if isinstance(r, Gps) and after(r, 16)][::10]
    readings = [moved(r, 60) if isinstance(r, Gps) and r.stamp_ns in outliers else r for r in made.readings]
    found = localiser(of, relock_fixes=3)  # outliers far apart are not "in a row"
    beliefs = run(found, of, readings)
    assert found.counters["gps_gated"] == len(outliers) >= 3
    assert found.counters["gps_relocked"] == 0
    assert max(position_errors(beliefs, made)) < 0.3


def test_filter_opens_up_again_after_a_lock_out() -> None:
    """The receiver is 60 m off for good, as after a change of its datum: the filter resists, then follows."""
    of = machine()
    made = drive([*S_BEND, Leg(10)], of)
    readings = [moved(r, 60) if isinstance(r, Gps) and after(r, 20) else r for r in made.readings]
    found = localiser(of, relock_fixes=15)
    beliefs = run(found, of, readings)
    assert (found.counters["gps_gated"], found.counters["gps_relocked"]) == (15, 1)
    x, y, _ = made.at(beliefs[-1].stamp_ns)
    assert math.dist((beliefs[-1].x_m, beliefs[-1].y_m), (x, y + 60)) < 3.0


def test_gates_count_per_receiver() -> None:
    """One receiver of two that is far off for good does not stop the other from being used."""
    of = machine(receivers=2)
    made = drive(S_BEND, of)
    readings = [
        moved(r, 40) if r.sensor == "gps-2" and 20 < (r.stamp_ns - START_NS) * 1e-9 < 23 else r for r in made.readings
    ]
    found = localiser(of)
    beliefs = run(found, of, readings)
    assert found.counters["gps_gated"] >= 14
    assert found.counters["gps_relocked"] == 0
    assert max(position_errors(beliefs, made)) < 0.4


@pytest.mark.parametrize("from_s", [12.0, 1e9])
def test_receiver_that_comes_late_or_never_is_no_trouble(from_s: float) -> None:
    of = machine(receivers=2)
    made = drive(S_BEND, of)
    found = localiser(of)
    beliefs = run(found, of, [r for r in made.readings if r.sensor != "gps-2" or after(r, from_s)])
    assert max(position_errors(beliefs, made)) < 0.3


def test_late_receiver_brings_its_own_unknown_error() -> None:
    """A second receiver that is 3 m off must not pull the position with the weight of its white noise alone."""
    of = machine(receivers=2)
    made = drive(S_BEND, of)
    readings = [
        moved(r, 3.0) if r.sensor == "gps-2" else r for r in made.readings if r.sensor != "gps-2" or after(r, 20)
    ]
    errors = position_errors(run(localiser(of), of, readings), made)
    first = next(i for i, b in enumerate(run(localiser(of), of, readings)) if b.stamp_ns > START_NS + 20_200_000_000)
    assert errors[first] - errors[first - 3] < 1.5
    assert max(errors) < 2.0


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_receiver_whose_error_is_all_white_or_all_slow_is_no_trouble(share: float) -> None:
    of = changed_sensor(machine(), "gps-1", drift_share=share)
    made = drive(S_BEND, of)
    assert max(position_errors(run(localiser(of), of, made.readings), made)) < 0.3


def biased(readings: list[Reading], bias_radps: float) -> list[Reading]:
    return [replace(r, gyro_z_radps=r.gyro_z_radps + bias_radps) if isinstance(r, Imu) else r for r in readings]


def test_standstill_shows_the_gyro_bias() -> None:
    of = machine()
    made = drive([*S_BEND, Leg(4, -0.5), Leg(6)], of, without=("torque",))
    found = localiser(of, standstill_s=1.0)
    run(found, of, biased(made.readings, 0.004))
    assert 4 <= found.counters["standstill_updates"] <= 7
    assert found._filter is not None
    assert found._filter.x[GYRO_BIAS] == pytest.approx(0.004, abs=3e-4)


def test_turning_on_the_spot_is_no_gyro_bias() -> None:
    """An articulated loader that steers at rest turns its rear frame."""
    of = machine()
    found = localiser(of)
    run(found, of, drive([*S_BEND, Leg(4, -0.5), Leg(3, 0.0, 0.1), Leg(1)], of, without=("torque",)).readings)
    assert found._filter is not None
    assert found.counters["standstill_gated"] >= 2
    assert abs(found._filter.x[GYRO_BIAS]) < 1e-3


def test_dead_reckoning_grows_unsure_and_a_fix_makes_it_sure_again() -> None:
    of = machine()
    made = drive([*S_BEND, Leg(20), Leg(2)], of)
    readings = [r for r in made.readings if not isinstance(r, Gps) or not after(r, 30) or after(r, 50)]
    beliefs = run(localiser(of), of, readings)

    def std_m(seconds: float) -> float:
        belief = next(b for b in beliefs if b.stamp_ns >= START_NS + seconds * 1e9)
        return float(np.sqrt(np.trace(belief.covariance_m2)))

    assert std_m(49.9) > 1.3 * std_m(30)
    assert std_m(51) < std_m(49.9)


def test_steps_are_no_longer_than_step_s() -> None:
    of = machine()
    made = drive(S_BEND, of)
    for step_s in (0.05, 0.2):
        stamps = [b.stamp_ns for b in run(localiser(of, step_s=step_s), of, made.readings)]
        assert max(np.diff(stamps)) <= (step_s + 0.021) * 1e9


def test_covariance_is_honest_and_the_error_below_raw_gps() -> None:
    """NEES of a 2-D position is 2 on average where the covariance is right; six short runs scatter around it."""
    nees, squares, raw = [], [], []
    for seed in range(6):
        site, of, readings, track = simulated(seed, 60.0)
        projection = Projection(site)
        found = Localiser(of, projection, LocalisationConfig(), ModelConfig())
        beliefs = [b for b in run(found, of, readings) if b.stamp_ns >= track["stamp_ns"][0]]
        assert found.is_aligned
        at = np.array([b.stamp_ns for b in beliefs], float) - float(START_NS)
        since = track["stamp_ns"].astype(float) - float(START_NS)
        error = np.stack(
            [
                [b.x_m for b in beliefs] - np.interp(at, since, track["x"]),
                [b.y_m for b in beliefs] - np.interp(at, since, track["y"]),
            ]
        ).T
        nees.append(np.mean([e @ np.linalg.solve(b.covariance_m2, e) for e, b in zip(error, beliefs, strict=True)]))
        squares.append(float((error**2).sum(axis=1).mean()))
        raw.append(raw_square_error(projection, readings, track, of))
    mean_nees, rms, raw_rms = float(np.mean(nees)), math.sqrt(np.mean(squares)), math.sqrt(np.mean(raw))
    told = f"seeds=0..5 nees={np.round(nees, 2)} rms={rms:.2f} raw={raw_rms:.2f}"
    assert 0.7 < mean_nees < 4.0, told
    assert rms < 0.9 * raw_rms, told


def raw_square_error(projection: Projection, readings: list[Reading], track: Any, of: MachineConfig) -> float:
    """Mean squared distance of raw fixes from the true antenna."""
    squares = []
    since = track["stamp_ns"].astype(float) - float(START_NS)
    for gps in (r for r in readings if isinstance(r, Gps)):
        sensor = of.sensor(gps.sensor)
        assert sensor
        t = float(gps.stamp_ns) - float(START_NS)
        x, y = np.interp(t, since, track["x"]), np.interp(t, since, track["y"])
        yaw = float(np.interp(t, since, np.unwrap(track["yaw"])))
        true = fix(sensor, gps.stamp_ns, 0.0, 0.0, yaw)
        lever = PROJECTION.to_map(true.lat_deg, true.lon_deg, true.height_m)[:2]
        east, north, _ = projection.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        squares.append((east - x - lever[0]) ** 2 + (north - y - lever[1]) ** 2)
    return float(np.mean(squares))


@pytest.mark.parametrize("name", list(LocalisationConfig.__dataclass_fields__))
def test_bad_localisation_option_is_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        LocalisationConfig(**{name: 0})
