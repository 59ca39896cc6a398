import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.localisation.filters.belief import PoseBelief
from agents.localisation.filters.state import BASE_STATES, YAW, Layout
from agents.localisation.localiser import LocalisationConfig
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Gps, Imu, Reading
from protocol.site.site_config import Projection
from tests.unit.agents.drives import (
    PROJECTION,
    S_BEND,
    START,
    START_NS,
    VEHICLE,
    Drive,
    Leg,
    RunLocaliser,
    after,
    biased,
    changed_sensor,
    drive,
    fix,
    localiser,
    machine,
    moved,
    noisy,
    simulated,
    with_ahrs,
)

GYRO_BIAS = Layout(imus=1).gyro_bias(0)
FILTERS = pytest.mark.parametrize("engine", ["ekf", "ukf"])


def state(located: RunLocaliser) -> Floats:
    return located.belief.x


def position_errors(beliefs: list[PoseBelief], made: Drive) -> list[float]:
    return [math.dist((b.x_m, b.y_m), made.at(b.stamp_ns)[:2]) for b in beliefs]


@pytest.mark.parametrize(  # each pair of choices once
    ("receivers", "profile", "engine"),
    [
        (1, "default", "ekf"),
        pytest.param(1, "paper", "ukf", marks=pytest.mark.nightly),  # filterpy's is slow
        (3, "default", "ukf"),
        (3, "paper", "ekf"),
    ],
)
def test_noiseless_readings_give_a_small_error(receivers: int, profile: str, engine: str) -> None:
    vehicle = machine(receivers=receivers)
    made = drive(S_BEND, vehicle)
    located = localiser(vehicle, filter=engine, profile=profile)
    beliefs = located.run(made.readings)
    assert located.is_aligned
    assert not [name for name in located.counters if not name.endswith("_used")]
    assert max(position_errors(beliefs, made)) < 0.3
    heading_errors = [abs(math.remainder(b.heading_rad - made.at(b.stamp_ns)[2], math.tau)) for b in beliefs]
    assert max(heading_errors) < 0.05
    assert all(-math.pi <= b.heading_rad <= math.pi for b in beliefs)


def test_nothing_that_was_driven_before_the_alignment_is_lost() -> None:
    made = drive([Leg(3), *S_BEND], VEHICLE)
    located = localiser(VEHICLE)
    aligned_ns = next(r.stamp_ns for r in made.readings if located.run([r]) and located.is_aligned)
    beliefs = localiser(VEHICLE).run([r for r in made.readings if not after(r, 30)])
    assert aligned_ns > START_NS + 8 * 10**9
    assert beliefs[0].stamp_ns <= START_NS + 200_000_000
    stamps = [b.stamp_ns for b in beliefs]
    assert stamps == sorted(stamps)
    assert max(np.diff(stamps)) <= 200_000_000


def test_no_pose_before_the_heading_is_known() -> None:
    located = localiser(VEHICLE)
    assert located.run(drive([Leg(60)], VEHICLE).readings) == []  # a parked machine
    straight = drive([Leg(4, 0.5), Leg(2)], VEHICLE, without=("gps-1",))
    assert localiser(VEHICLE).run(straight.readings) == []
    assert not located.is_aligned


def test_filter_opens_up_again_after_a_lock_out() -> None:
    """The receiver is 60 m off for good, as after a change of its datum: the filter resists, then follows."""
    made = drive([*S_BEND, Leg(20)], VEHICLE)
    readings = moved(made.readings, 60, from_s=40)
    located = localiser(VEHICLE)
    beliefs = located.run(readings)
    assert (located.counters["gps-1_gated"], located.counters["gps-1_relocked"]) == (15, 1)
    x, y, _ = made.at(beliefs[-1].stamp_ns)
    assert math.dist((beliefs[-1].x_m, beliefs[-1].y_m), (x, y + 60)) < 3.0


@pytest.mark.slow
def test_late_receiver_brings_its_own_unknown_error() -> None:
    """A second receiver that is 3 m off must not pull the position with the weight of its white noise alone."""
    vehicle = machine(receivers=2)
    made = drive(S_BEND, vehicle)
    readings = moved([r for r in made.readings if r.sensor != "gps-2" or after(r, 20)], 3.0, "gps-2")
    beliefs = localiser(vehicle).run(readings)
    errors = position_errors(beliefs, made)
    first = next(i for i, b in enumerate(beliefs) if b.stamp_ns > START_NS + 20_200_000_000)
    assert errors[first] - errors[first - 3] < 1.5
    assert max(errors) < 2.0


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_receiver_whose_error_is_all_white_or_all_slow_is_no_trouble(share: float) -> None:
    vehicle = changed_sensor(machine(), "gps-1", drift_share=share)
    made = drive(S_BEND, vehicle)
    assert max(position_errors(localiser(vehicle).run(made.readings), made)) < 0.3


@pytest.mark.slow
def test_turning_on_the_spot_is_no_gyro_bias() -> None:
    """An articulated loader that steers at rest turns its rear frame."""
    located = localiser(VEHICLE)
    made = drive([*S_BEND, Leg(4, -0.5), Leg(3, 0.0, 0.1), Leg(1)], VEHICLE, without=("torque",))
    located.run(made.readings)
    assert located.counters["standstill_gated"] >= 30
    assert located.counters["standstill_relocked"] == 0
    assert abs(state(located)[GYRO_BIAS]) < 1e-3
    assert abs(math.remainder(state(located)[YAW] - made.heading_rad[-1], math.tau)) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["ekf", pytest.param("ukf", marks=pytest.mark.nightly)])
def test_covariance_is_honest_and_the_error_below_raw_gps(engine: str) -> None:
    """NEES of a 2-D position is 2 on average where the covariance is right; four short runs scatter around it."""
    nees, squares, raw = [], [], []
    for seed in range(4):
        site, vehicle, readings, track = simulated(seed, 50.0)
        projection = Projection(site)
        located = RunLocaliser(vehicle, projection, LocalisationConfig(filter=engine))
        beliefs = [b for b in located.run(readings) if b.stamp_ns >= track["stamp_ns"][0]]
        assert located.is_aligned
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
        raw.append(raw_square_error(projection, readings, track, vehicle))
    mean_nees, rms, raw_rms = float(np.mean(nees)), math.sqrt(np.mean(squares)), math.sqrt(np.mean(raw))
    shown = f"seeds=0..3 nees={np.round(nees, 2)} rms={rms:.2f} raw={raw_rms:.2f}"
    assert 0.7 < mean_nees < 4.0, shown
    assert rms < 0.9 * raw_rms, shown


def raw_square_error(projection: Projection, readings: list[Reading], track: Any, vehicle: MachineConfig) -> float:
    """Mean squared distance of raw fixes from the true antenna."""
    squares = []
    since = track["stamp_ns"].astype(float) - float(START_NS)
    for gps in (r for r in readings if isinstance(r, Gps)):
        sensor = vehicle.sensor(gps.sensor)
        t = float(gps.stamp_ns) - float(START_NS)
        x, y = np.interp(t, since, track["x"]), np.interp(t, since, track["y"])
        yaw = float(np.interp(t, since, np.unwrap(track["yaw"])))
        true = fix(sensor, gps.stamp_ns, 0.0, 0.0, yaw)
        lever = PROJECTION.to_map(true.lat_deg, true.lon_deg, true.height_m)[:2]
        east, north, _ = projection.to_map(gps.lat_deg, gps.lon_deg, gps.height_m)
        squares.append((east - x - lever[0]) ** 2 + (north - y - lever[1]) ** 2)
    return float(np.mean(squares))


# --- late readings, a given start, profiles, more IMUs ---------------------------------------------------------


@pytest.mark.slow
def test_first_fix_that_is_refused_does_not_count_as_heard() -> None:
    vehicle = machine(receivers=2)
    made = drive(S_BEND, vehicle)
    readings = [r for r in made.readings if r.sensor != "gps-2" or after(r, 20)]
    old = next(r for r in made.readings if r.sensor == "gps-2" and after(r, 10))
    first = next(i for i, r in enumerate(readings) if r.sensor == "gps-2")
    located, without = localiser(vehicle), localiser(vehicle)
    located.run([*readings[:first], old, *readings[first:]])
    without.run(readings)
    assert located.counters["too_late"] == without.counters["too_late"] + 1
    assert state(located) == pytest.approx(state(without), abs=1e-9)


@pytest.mark.parametrize(("profile", "engine"), [("default", "ukf"), ("paper", "ekf")])
def test_a_given_start_needs_no_gps(profile: str, engine: str) -> None:
    vehicle = machine(receivers=0)
    made = drive(S_BEND, vehicle)
    located = localiser(vehicle, start=START, profile=profile, filter=engine)
    beliefs = located.run(made.readings)
    assert beliefs[0].stamp_ns <= START_NS + 70_000_000
    assert max(position_errors(beliefs, made)) < 0.6
    assert abs(math.remainder(beliefs[-1].heading_rad - made.heading_rad[-1], math.tau)) < 0.02


def test_a_given_start_may_lie_anywhere() -> None:
    vehicle = machine(receivers=0)
    located = localiser(vehicle, start=(-500.0, 70.0, 0.7 + math.pi))
    made = drive(S_BEND, vehicle)
    last = located.run(made.readings)[-1]
    x, y, heading = made.at(last.stamp_ns)
    assert (last.x_m, last.y_m) == pytest.approx((-500 - (x - 10), 70 - (y - 20)), abs=0.6)
    assert abs(math.remainder(last.heading_rad - heading - math.pi, math.tau)) < 0.02


BENDS = (Leg(4, 1.0), *(Leg(3, 0.0, rate) for rate in (0.3, -0.2, 0.25, -0.35, 0.3, -0.3)))


@FILTERS
def test_without_gps_the_motion_teaches_nothing_that_it_does_not_show(engine: str) -> None:
    """Forces that are off on one side are neither a turn nor a bias of the gyro; wheels do not show their own scale."""
    vehicle = machine(receivers=0)
    made = drive(BENDS, vehicle)
    off = [replace(r, force_y_mps2=r.force_y_mps2 + 0.8) if isinstance(r, Imu) else r for r in made.readings]
    located = localiser(vehicle, start=START, filter=engine)
    beliefs = located.run(noisy(off, 1))
    layout = Layout(imus=1, wheel_scale=True)
    assert state(located)[layout.gyro_biases.start : layout.wheel_scales.stop].tolist() == [0.0, 0.0]
    turned = [abs(math.remainder(b.heading_rad - made.at(b.stamp_ns)[2], math.tau)) for b in beliefs]
    assert max(turned) < 0.06  # noise of the gyro, and a step in which it turns at 0.35 rad/s


def test_fixes_that_are_refused_are_as_no_gps() -> None:
    made = drive(BENDS, VEHICLE)
    outliers = [r.stamp_ns for r in made.readings if isinstance(r, Gps) and after(r, 4)][::10]
    heard = [r for r in made.readings if not (isinstance(r, Gps) and after(r, 4)) or r.stamp_ns in outliers]
    off = [replace(r, force_y_mps2=r.force_y_mps2 + 0.8) if isinstance(r, Imu) else r for r in heard]
    readings = moved(off, 60, from_s=4)
    located = localiser(VEHICLE, start=START)
    located.run(r for r in readings if not after(r, 10))
    learnt = slice(GYRO_BIAS, Layout(imus=1, wheel_scale=True).wheel_scales.stop)
    before = state(located)[learnt].tolist()
    located.run(r for r in readings if after(r, 10))
    assert located.counters["gps-1_gated"] == len(outliers) == 9
    assert state(located)[learnt].tolist() == before


def test_without_gps_a_standstill_still_shows_the_gyro_bias() -> None:
    vehicle = machine(receivers=0)
    made = drive([*BENDS, Leg(4, -1.0), Leg(6)], vehicle, without=("torque",))
    located = localiser(vehicle, start=START)
    beliefs = located.run(biased(made.readings, 0.004))
    assert state(located)[GYRO_BIAS] == pytest.approx(0.004, abs=1e-4)
    off_rad = math.remainder(beliefs[-1].heading_rad - made.heading_rad[-1], math.tau)
    assert abs(off_rad) < 0.25 * 0.004 * 28  # and most of what it turned the machine by


@pytest.mark.slow
def test_without_gps_an_unsure_heading_does_not_shorten_the_distance() -> None:
    """Two minutes straight on: the gyro's bias may have turned the machine by a right angle, most likely it did not."""
    vehicle = machine(receivers=0)
    made = drive([Leg(4, 1.0), Leg(116)], vehicle)
    located = localiser(vehicle, start=START, filter="ukf")
    last = located.run(made.readings)[-1]
    assert located.belief.P[YAW, YAW] > 0.4**2
    x, y, _ = made.at(last.stamp_ns)
    driven_m = math.dist(START[:2], (x, y))
    assert math.dist(START[:2], (last.x_m, last.y_m)) == pytest.approx(driven_m, rel=0.01)


@pytest.mark.slow
def test_paper_has_15_states_and_follows_orientations_whose_error_the_default_learns() -> None:
    vehicle = replace(VEHICLE, sensors=(*VEHICLE.sensors, SensorConfig("ahrs", "attitude")))
    made = drive(S_BEND, vehicle)
    off, states, used = {}, {}, {}
    for profile in ("paper", "default"):
        located = localiser(vehicle, profile=profile)
        located.run(with_ahrs(made, 0.1))
        states[profile] = len(state(located))
        used[profile] = located.counters["ahrs_used"]
        off[profile] = math.remainder(state(located)[YAW] - made.heading_rad[-1], math.tau)
    assert states == {"paper": BASE_STATES, "default": BASE_STATES + 1 + 1 + 2 + 1}
    assert used["paper"] > 500
    assert 20 < used["default"] < 100  # one in half a second
    assert off["paper"] > 0.05
    assert abs(off["default"]) < 0.03


# --- smoothing -------------------------------------------------------------------------------------------------------


def with_wrong_fixes(made: Drive, seed: int) -> list[Reading]:
    """Fixes that are off by some metres, slowly changing."""
    rng, off_m, readings = np.random.default_rng(seed), np.zeros(2), []
    for reading in made.readings:
        if isinstance(reading, Gps):
            off_m = 0.97 * off_m + 0.3 * rng.normal(size=2)
            x, y, _ = PROJECTION.to_map(reading.lat_deg, reading.lon_deg, 0.0)
            lat, lon, _ = PROJECTION.to_geodetic(x + off_m[0], y + off_m[1], 0.0)
            reading = replace(reading, lat_deg=lat, lon_deg=lon)
        readings.append(reading)
    return readings


@pytest.mark.slow
def test_smoothed_places_are_nearer_to_the_truth_from_the_first_step_on() -> None:
    """Those from before the alignment too: they are smoothed as the collected readings are filtered."""
    made = drive((*S_BEND, Leg(30)), VEHICLE)
    located = localiser(VEHICLE, filter="ekf", lag_s=25.0)
    located.run(with_wrong_fixes(made, 4))
    final = located.take_smoothed()
    poses = final + located.remaining()
    assert not located.take_smoothed()
    assert [p.stamp_ns for p in poses] == sorted({p.stamp_ns for p in poses})
    assert (poses[0].stamp_ns - START_NS) * 1e-9 < 1.0
    assert poses[-1].stamp_ns == located.belief.stamp_ns
    assert len(final) == pytest.approx(60 - 25, abs=2)
    true = np.array([made.at(p.stamp_ns) for p in final])
    off_m = np.array([(p.x_m, p.y_m) for p in final]) - true[:, :2]
    filtered_m = off_m - np.array([p.correction[:2] for p in final])
    assert np.hypot(*off_m.T).mean() < 0.8 * np.hypot(*filtered_m.T).mean()
    turned = [math.remainder(p.heading_rad - t, math.tau) for p, t in zip(final, true[:, 2].tolist(), strict=True)]
    assert np.abs(turned).max() < 0.05


@pytest.mark.parametrize("options", [{"profile": "paper"}, {"lag_s": 0.0}])
def test_without_a_smoother_there_are_no_smoothed_poses(options: dict[str, Any]) -> None:
    located = localiser(VEHICLE, start=START, **options)
    located.run(drive((Leg(3, 0.5),), VEHICLE).readings)
    assert located.is_aligned
    assert located.take_smoothed() == located.remaining() == []


# --- configuration ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("filter", "kf"),
        ("profile", "planar"),
        ("slip", -0.1),
        ("slip", 1.0),
        ("start", (1.0, 2.0)),
        ("start", (math.nan,) * 3),
        ("lag_s", -1.0),
        ("lag_s", math.nan),
        ("lag_s", 1e6),
    ],
)
def test_bad_choice_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name}: "):
        LocalisationConfig(**{name: value})
