import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.localisation.filters.state import BASE_STATES, YAW, Layout
from agents.localisation.localiser import LocalisationConfig
from protocol.arrays import Floats
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Articulation, Gps, Imu, Reading
from protocol.site.site_config import Projection
from tests.unit.agents.drives import (
    S_BEND,
    START,
    START_NS,
    VEHICLE,
    Leg,
    RunLocaliser,
    after,
    biased,
    drive,
    localiser,
    machine,
    moved,
    noisy,
    simulated,
    thinned,
    with_ahrs,
)

GYRO_BIAS = Layout(imus=1).gyro_bias(0)
FILTERS = pytest.mark.parametrize("engine", ["ekf", "ukf"])


def state(located: RunLocaliser) -> Floats:
    return located.belief.x


@pytest.mark.parametrize(  # all pairs of choices
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
    beliefs = located.run(thinned(made.readings, 20))
    assert located.is_aligned
    assert not [name for name in located.counters if not name.endswith("_used")]
    assert max(map(made.off_m, beliefs)) < 0.3
    assert max(map(made.turned_rad, beliefs)) < 0.05
    assert all(-math.pi <= b.heading_rad <= math.pi for b in beliefs)


@pytest.mark.slow
def test_late_receiver_brings_its_own_unknown_error() -> None:
    """A second receiver 3 m off must count with more than its white noise."""
    vehicle = machine(receivers=2)
    made = drive(S_BEND, vehicle)
    readings = moved([r for r in thinned(made.readings) if r.sensor != "gps-2" or after(r, 20)], 3.0, "gps-2")
    beliefs = localiser(vehicle).run(readings)
    errors = [made.off_m(b) for b in beliefs]
    first = next(i for i, b in enumerate(beliefs) if b.stamp_ns > START_NS + 20_200_000_000)
    assert errors[first] - errors[first - 3] < 1.5
    assert max(errors) < 2.0


@pytest.mark.slow
def test_turning_on_the_spot_is_no_gyro_bias() -> None:
    """An articulated loader steering at rest turns its rear frame."""
    located = localiser(VEHICLE)
    made = drive([*S_BEND, Leg(4, -0.5), Leg(3, 0.0, 0.1), Leg(1)], VEHICLE, without=("torque",))
    located.run(thinned(made.readings))
    assert located.counters["standstill_gated"] >= 30
    assert located.counters["standstill_relocked"] == 0
    assert abs(state(located)[GYRO_BIAS]) < 1e-3
    assert made.turned_rad(located.belief) < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("joint_radps", "bias_radps", "off_rad"), [(0.0094, 0.0, 0.0), (0.0, 0.0033, 0.12)])
def test_slow_turn_at_rest_is_no_gyro_bias_if_the_joint_shows_it(
    joint_radps: float, bias_radps: float, off_rad: float
) -> None:
    """The rear frame turns by 0.27 deg/s for 15 s, below the gate of a standstill; the joint twice as fast."""
    vehicle = replace(VEHICLE, sensors=(*VEHICLE.sensors, SensorConfig("joint", "articulation")))
    made = drive([*S_BEND, Leg(4, -0.5, 0.0047), Leg(15, 0.0, 0.0047), Leg(5)], vehicle, without=("torque",))
    noise = np.random.default_rng(3)
    bent = [
        replace(r, angle_rad=joint_radps * seconds_between(r, 30.0, 49.0) + noise.normal(0, 0.0035))
        if isinstance(r, Articulation)
        else r
        for r in thinned(made.readings)
    ]
    located = localiser(vehicle)
    located.run(bent)
    assert state(located)[GYRO_BIAS] == pytest.approx(bias_radps, abs=2e-4)
    assert made.turned_rad(located.belief) == pytest.approx(off_rad, abs=0.01)


def seconds_between(reading: Reading, from_s: float, to_s: float) -> float:
    return min(max((reading.stamp_ns - START_NS) * 1e-9 - from_s, 0.0), to_s - from_s)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["ekf", pytest.param("ukf", marks=pytest.mark.nightly)])
def test_covariance_is_honest(engine: str) -> None:
    """A consistent 2-D position has mean NEES 2; short runs scatter."""
    nees, squares = [], []
    for seed in range(2):
        site, vehicle, readings, track = simulated(seed, 50.0)
        located = RunLocaliser(vehicle, Projection(site), LocalisationConfig(filter=engine))
        beliefs = [b for b in located.run(thinned(readings)) if b.stamp_ns >= track["stamp_ns"][0]]
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
    mean_nees, rms = float(np.mean(nees)), math.sqrt(np.mean(squares))
    shown = f"seeds=0, 1 nees={np.round(nees, 2)} rms={rms:.2f}"
    assert 0.7 < mean_nees < 4.0, shown
    assert rms < 1.5, shown


# --- late readings, a given start, profiles, more IMUs ---------------------------------------------------------


@pytest.mark.parametrize(("profile", "engine"), [("default", "ukf"), ("paper", "ekf")])
def test_a_given_start_needs_no_gps(profile: str, engine: str) -> None:
    vehicle = machine(receivers=0)
    made = drive(S_BEND, vehicle)
    located = localiser(vehicle, start=START, profile=profile, filter=engine)
    beliefs = located.run(made.readings)
    assert beliefs[0].stamp_ns <= START_NS + 70_000_000
    assert max(map(made.off_m, beliefs)) < 0.6
    assert made.turned_rad(beliefs[-1]) < 0.02


BENDS = (Leg(4, 1.0), *(Leg(3, 0.0, rate) for rate in (0.3, -0.2, 0.25, -0.35, 0.3, -0.3)))


@FILTERS
def test_without_gps_the_motion_teaches_nothing_that_it_does_not_show(engine: str) -> None:
    """One-sided force errors are neither turn nor gyro bias; wheels do not show their scale."""
    vehicle = machine(receivers=0)
    made = drive(BENDS, vehicle)
    off = [replace(r, force_y_mps2=r.force_y_mps2 + 0.8) if isinstance(r, Imu) else r for r in made.readings]
    located = localiser(vehicle, start=START, filter=engine)
    beliefs = located.run(noisy(off, 1))
    layout = Layout(imus=1, wheel_scale=True)
    assert state(located)[layout.gyro_biases.start : layout.wheel_scales.stop].tolist() == [0.0, 0.0]
    assert max(map(made.turned_rad, beliefs)) < 0.06  # gyro noise and a step at 0.35 rad/s


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
    assert made.turned_rad(beliefs[-1]) < 0.25 * 0.004 * 28  # most of the wrong turn is undone


@pytest.mark.slow
def test_without_gps_an_unsure_heading_does_not_shorten_the_distance() -> None:
    """Two minutes straight: the gyro bias may mean a right angle, but most likely none."""
    vehicle = machine(receivers=0)
    made = drive([Leg(4, 1.0), Leg(116)], vehicle)
    located = localiser(vehicle, start=START, filter="ukf")
    last = located.run(thinned(made.readings, 200))[-1]
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
        located.run(thinned(with_ahrs(made, 0.1), 20))
        states[profile] = len(state(located))
        used[profile] = located.counters["ahrs_used"]
        off[profile] = math.remainder(state(located)[YAW] - made.heading_rad[-1], math.tau)
    assert states == {"paper": BASE_STATES, "default": BASE_STATES + 1 + 1 + 2 + 1}
    assert used["paper"] > 500
    assert 20 < used["default"] < 100  # one in half a second
    assert off["paper"] > 0.05
    assert abs(off["default"]) < 0.03


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("filter", "kf"),
        ("profile", "planar"),
        ("slip", 1.0),
        ("start", (1.0, 2.0)),
        ("start", (math.nan,) * 3),
        ("lag_s", math.nan),
        ("lag_s", 1e6),
    ],
)
def test_bad_choice_is_refused_by_name(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"^{name}: "):
        LocalisationConfig(**{name: value})
