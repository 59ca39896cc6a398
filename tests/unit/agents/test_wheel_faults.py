"""Dead, frozen, slipping or reversed wheels, carried machines: named, excluded, used again.

Synthetic drives with slow and white receiver errors; each fault is compared with the faultless drive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby

import numpy as np
import pytest

from agents.dead_reckoning import DeadReckoning
from agents.localisation.localiser import LocalisationConfig
from agents.localisation.wheels.judge import OTHER_WAY, Fault, WheelJudge
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.stream_order import by_stamp
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Gps, GpsVelocity, Imu, Odometry, Reading
from tests.tiers import by_night
from tests.unit.agents.drives import LEVER_M, PROJECTION, SITE, Drive, Leg, drive, noisy, seconds, simulated, thinned
from tests.unit.agents.test_receiver_faults import FAULTS as RECEIVER_FAULTS
from tests.unit.agents.test_receiver_faults import RECEIVER, SLOW_S, SLOW_SHARE, STD_M, shifted
from tests.unit.agents.test_receiver_faults import measured as usual_drive

pytestmark = pytest.mark.slow
SEED = 1
STOP_S, REVERSE_S = 74.0, 82.0  # of standstill and reversing
GPS = SensorConfig("gps-1", "gps", Mount(LEVER_M), drift_share=SLOW_SHARE, drift_time_s=SLOW_S)
IMU = SensorConfig("imu", "imu")
LEFT, RIGHT = (
    SensorConfig(n, "odometry", Mount((0.0, y, 0.0)), ("speed",)) for n, y in (("left", 0.9), ("right", -0.9))
)
ODOMETRY = SensorConfig("wheels", "odometry", measures=("speed",))
ENCODER = SensorConfig("wheels", "encoder")
Read = Callable[[float, float], float]  # seconds, true speed -> reading


def legs(speed_mps: float) -> tuple[Leg, ...]:
    """Bends, a stop, 1.5 m/s in reverse, and on."""
    bends = [Leg(5, 0.0, 0.75 / speed_mps), Leg(7), Leg(4, 0.0, -0.9 / speed_mps), Leg(5)]
    start, stop = Leg(4, speed_mps / 4), Leg(4, -speed_mps / 4)
    return (Leg(3), start, *bends * 3, stop, Leg(8), Leg(3, -0.5), Leg(10), Leg(3, 0.5), Leg(3), start, *bends * 3)


def cart(*sensors: SensorConfig) -> MachineConfig:
    return MachineConfig("loader-1", sensors=(IMU, GPS, *sensors))


@cache
def truth(speed_mps: float) -> Drive:
    return drive(legs(speed_mps), cart())


@dataclass(frozen=True)
class Case:
    """Wheel readings. ends_s: right again; begin_s: fault visible."""

    expected: Fault
    read: Read
    begin_s: float
    wheels: tuple[SensorConfig, ...] = (ODOMETRY,)
    speed_mps: float = 3.0
    ends_s: float = math.inf
    half: bool = False  # one encoder channel


def stands(begin_s: float, end_s: float = math.inf) -> Read:
    return lambda s, v: 0.0 if begin_s <= s < end_s else v


def sound(_: float, v: float) -> float:
    return v


DIED = Case(Fault.DIED, stands(40.0), 40.0)
CARRIED = Case(Fault.CARRIED, stands(STOP_S + 2, STOP_S + 62), REVERSE_S + 4, ends_s=STOP_S + 62)
UNSIGNED = Case(Fault.UNSIGNED, lambda _, v: abs(v), REVERSE_S)
REVERSED = Case(Fault.REVERSED, lambda _, v: -v, 3.0)
CASES = {
    "dead": DIED,
    "dead, encoder, recovers": replace(DIED, wheels=(ENCODER,), read=stands(40.0, 100.0), ends_s=106.0),
    "dead, in a bend, faster": replace(DIED, read=stands(30.0), begin_s=30.0, speed_mps=8.0),
    "one of two dead": replace(DIED, wheels=(LEFT, RIGHT)),
    "carried": CARRIED,
    "unsigned": UNSIGNED,
    "unsigned, encoder": replace(UNSIGNED, wheels=(ENCODER,)),
    "reversed": REVERSED,
    "reversed, encoder": replace(REVERSED, wheels=(ENCODER,)),
    "reversed later": Case(Fault.REVERSED, lambda s, v: -v if s > 45 else v, 45.0),
    "half": Case(Fault.HALF, stands(40.0), 40.0, (ENCODER,), half=True),
    "stuck": Case(Fault.STUCK, lambda s, v: v if s < 60 else 3.0, STOP_S),
    "spinning": Case(Fault.SLIPS, lambda s, v: v + 4 * np.clip(s - 40, 0, 1) * (s < 60), 40.0, ends_s=60.0),
}
LOCATED = ("dead", "reversed")
AT_NIGHT = ("carried", "dead, encoder, recovers", "one of two dead", "unsigned")


@cache
def unmoved(speed_mps: float, seed: int) -> list[Reading]:
    """All readings but wheels; a quarter of the fast ones, to save time."""
    rng, slow_m, kept = np.random.default_rng(seed), math.sqrt(SLOW_SHARE) * STD_M, math.exp(-0.2 / SLOW_S)
    error, readings = slow_m * rng.standard_normal(2), []
    for r in noisy(thinned(truth(speed_mps).readings, 40), seed):
        if isinstance(r, Gps):
            error = kept * error + slow_m * math.sqrt(1 - kept**2) * rng.standard_normal(2)
            r = shifted(r, *(error + math.sqrt(1 - SLOW_SHARE) * STD_M * rng.standard_normal(2)).tolist())
        readings.append(r)
    return readings


def shown(case: Case, seed: int = SEED) -> list[Reading]:
    """All readings of a drive."""
    made = truth(case.speed_mps)
    wheels = [r for i, sensor in enumerate(case.wheels) for r in rolled(case, made, sensor, faulty=not i)]
    return sorted([*unmoved(case.speed_mps, seed), *wheels], key=lambda r: r.stamp_ns)


def rolled(case: Case, made: Drive, sensor: SensorConfig, *, faulty: bool) -> list[Reading]:
    """One wheel sensor's readings at 20 Hz."""
    speeds = made.speed_mps - sensor.mount.xyz_m[1] * np.gradient(made.heading_rad, 0.01)
    times_s = np.arange(1, len(speeds) + 1) * 0.01
    wrong = np.array([case.read(s, v) for s, v in zip(times_s.tolist(), speeds.tolist(), strict=True)])
    ticks_per_m = sensor.ticks_per_rev / (2 * math.pi * cart().wheel_radius_m)
    left, right = (np.floor(np.cumsum(v) * 0.01 * ticks_per_m) for v in (wrong, speeds if case.half else wrong))
    values = wrong if faulty else speeds
    every = range(4, len(speeds), 5)
    if sensor.kind == "encoder":
        return [Encoder(sensor.name, made.stamps_ns[i], float(left[i]), float(right[i])) for i in every]
    return [Odometry(sensor.name, made.stamps_ns[i], float(values[i]), 0.0, 0.0) for i in every]


def verdicts(vehicle: MachineConfig, readings: Sequence[Reading]) -> list[tuple[float, dict[str, str]]]:
    """Changes of verdict: seconds since the start, sentence by sensor."""
    judge, reckoned = WheelJudge(vehicle, PROJECTION), DeadReckoning(vehicle, 0.0)
    said: list[tuple[float, dict[str, str]]] = [(0.0, {})]
    for _, same in groupby(sorted(readings, key=lambda r: r.stamp_ns), key=lambda r: r.stamp_ns):
        (group,) = by_stamp(same)
        for reading, sensor in judge.heard([(r, vehicle.sensor(r.sensor)) for r in group], reckoned, lambda _: 1.0):
            reckoned.update(reading, sensor)
        if judge.problems != said[-1][1]:
            said.append((seconds(group[0]), judge.problems))
    return said[1:]


@pytest.mark.parametrize("name", CASES)
def test_a_fault_is_named_within_ten_seconds_and_until_it_ends(name: str) -> None:
    case = CASES[name]
    (at_s, said), *later = verdicts(cart(*case.wheels), shown(case))
    assert said == {case.wheels[0].name: case.expected.value}
    assert case.begin_s <= at_s <= case.begin_s + 10, at_s
    assert [problems for _, problems in later] == [{}] * (case.ends_s < math.inf)
    assert all(case.ends_s <= s <= case.ends_s + 15 for s, _ in later)


@dataclass(frozen=True)
class Outcome:
    """Live poses: errors [m], normalised squares (n,), times [s]; final health."""

    seconds: Floats
    off_m: Floats
    nees: Floats
    faults: dict[str, str]


def located(case: Case, readings: Sequence[Reading]) -> Outcome:
    config = PipelineConfig(LocalisationConfig("ekf", slip=0.0, slip_soft=0.0))
    pipeline, poses, made = Pipeline(SITE, cart(*case.wheels), config), [], truth(case.speed_mps)
    for _, group in groupby(readings, key=lambda r: r.stamp_ns - r.stamp_ns % 200_000_000):
        pipeline.step(list(group))
        poses += [pipeline.pose] if pipeline.pose else []
    errors = np.array([(p.x_m, p.y_m) for p in poses]) - [made.at(p.stamp_ns)[:2] for p in poses]
    nees = np.array([e @ np.linalg.solve(p.covariance_m2, e) for e, p in zip(errors, poses, strict=True)])
    return Outcome(np.array([seconds(p) for p in poses]), np.hypot(*errors.T), nees, pipeline.health()["faults"])


@cache
def passing(wheels: tuple[SensorConfig, ...]) -> Outcome:
    case = replace(DIED, wheels=wheels, read=sound)
    return located(case, shown(case))


@pytest.mark.parametrize("name", [*LOCATED, *by_night(AT_NIGHT)])
def test_positions_are_nearly_as_good_as_without_the_fault(name: str) -> None:
    case = CASES[name]
    outcome, without = located(case, shown(case)), passing(case.wheels)
    later, beside = (one.seconds > case.begin_s + 15 for one in (outcome, without))
    off_m, nees, sound_m = outcome.off_m[later], outcome.nees[later], without.off_m[beside]
    rms_m, sound_rms_m = (float(np.sqrt(np.mean(np.square(values)))) for values in (off_m, sound_m))
    figures = f"seed={SEED} rms {rms_m:.2f} of {sound_rms_m:.2f} nees {nees.mean():.2f} in {(nees < 5.99).mean():.2f}"
    assert rms_m <= max(2 * sound_rms_m, 1.0), figures
    assert off_m.max() <= max(2 * sound_m.max(), 4.0), figures
    assert nees.mean() <= 4.0, figures
    assert (nees < 5.99).mean() >= 0.9, figures
    assert bool(outcome.faults) == (case.ends_s == math.inf)
    assert without.faults == {}


SOUND: dict[str, tuple[Read, tuple[SensorConfig, ...]]] = {  # faultless wheels
    "passing": (sound, (ODOMETRY,)),
    "passing, encoder": (sound, (ENCODER,)),
    "passing, two": (sound, (LEFT, RIGHT)),
    "another radius": (lambda _, v: 0.75 * v, (ENCODER,)),
    "km/h": (lambda _, v: 3.6 * v, (ODOMETRY,)),
    "too few ticks": (lambda _, v: 0.1 * v, (ENCODER,)),
    "slip uphill": (lambda s, v: v * (1.25 if 40 < s < 60 else 1.0), (LEFT, RIGHT)),
}


@pytest.mark.parametrize("name", SOUND)
def test_sound_wheels_are_not_condemned(name: str) -> None:
    read, wheels = SOUND[name]
    assert verdicts(cart(*wheels), shown(replace(DIED, wheels=wheels, read=read))) == []


@pytest.mark.parametrize("name", RECEIVER_FAULTS)
def test_faults_of_receivers_are_not_the_wheels(name: str) -> None:
    assert verdicts(RECEIVER, RECEIVER_FAULTS[name][0](usual_drive())) == []


def test_a_receiver_that_drifts_beside_a_parked_machine_condemns_no_wheels() -> None:
    parked = noisy(thinned(drive([Leg(60)], RECEIVER).readings, 40), SEED)
    assert verdicts(RECEIVER, [shifted(r, seconds(r), 0.0) if isinstance(r, Gps) else r for r in parked]) == []


def test_clocks_apart_are_not_the_wheels() -> None:
    made = shown(replace(DIED, read=sound))
    late = [replace(r, stamp_ns=r.stamp_ns + 18 * 10**9) if isinstance(r, Gps) else r for r in made]
    assert verdicts(cart(ODOMETRY), late) == []


def test_an_accelerometer_that_faces_back_is_named_in_place_of_the_wheels() -> None:
    turned = [
        replace(r, force_x_mps2=-r.force_x_mps2, gyro_y_radps=-r.gyro_y_radps) if isinstance(r, Imu) else r
        for r in shown(replace(DIED, read=sound))
    ]
    said = verdicts(cart(ODOMETRY), turned)
    assert said
    assert all(problems in ({}, {"imu": OTHER_WAY}) for _, problems in said)


def test_doppler_velocities_judge_wheels_too() -> None:
    doppler = SensorConfig("doppler", "gps_velocity")
    vehicle = replace(cart(ODOMETRY), sensors=(IMU, doppler, ODOMETRY))
    made, rng = truth(3.0), np.random.default_rng(SEED)
    velocities = made.speed_mps[:, None] * np.stack([np.cos(made.heading_rad), np.sin(made.heading_rad)], axis=1)
    seen = [
        GpsVelocity("doppler", made.stamps_ns[i], *(velocities[i] + 0.1 * rng.standard_normal(2)).tolist(), 0.01, 0.01)
        for i in range(0, len(velocities), 50)
    ]
    readings = [r for r in shown(DIED) if not isinstance(r, Gps)] + seen
    ((at_s, said),) = verdicts(vehicle, readings)
    assert said == {"wheels": Fault.DIED.value}
    assert at_s <= DIED.begin_s + 10


@pytest.mark.nightly
@pytest.mark.parametrize("seed", [0, 1])
def test_simulated_drives_have_no_fault(seed: int) -> None:
    _, vehicle, readings, _ = simulated(seed, 120.0)
    assert verdicts(vehicle, readings) == []
