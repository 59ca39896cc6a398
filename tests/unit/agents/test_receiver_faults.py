"""Receivers that are off, hang or repeat themselves: positions recover, and nothing wrong reaches the map.

Each drive is made up, with a slow and a white error of the receiver; each fault is judged beside the drive without it.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from enum import Enum
from functools import cache
from itertools import groupby

import numpy as np
import pytest

from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import joined
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, Reading
from tests.unit.agents.drives import PROJECTION, SITE, START_NS, VEHICLE, Drive, Leg, drive, noisy, thinned

STD_M, SLOW_SHARE, SLOW_S = 1.2, 0.75, 45.0  # of the receiver, as it states and as a machine's description has it
LEGS = (Leg(3), Leg(4, 1.0), Leg(6), *[Leg(5, 0.0, 0.25), Leg(7), Leg(4, 0.0, -0.3), Leg(6)] * 4)
SETTLED_S = 30.0  # of good input
SEED = 1
Change = Callable[[Gps, float], Gps]  # a fix, and seconds since the begin


def shifted(fix: Gps, off_m: float, std_m: float = STD_M) -> Gps:
    """The fix so far to the north-east."""
    x, y, z = PROJECTION.to_map(fix.lat_deg, fix.lon_deg, fix.height_m)
    lat, lon, _ = PROJECTION.to_geodetic(x + 0.6 * off_m, y + 0.8 * off_m, z)
    return replace(fix, lat_deg=lat, lon_deg=lon, var_e_m2=std_m**2, var_n_m2=std_m**2)


def off(metres: float, seconds: float, *, states: bool) -> Change:
    """A receiver that has just started."""
    return lambda fix, s: shifted(fix, metres, metres if states else STD_M) if s < seconds else fix


def converging(metres: float, tau_s: float) -> Change:
    def changed(fix: Gps, s: float) -> Gps:
        left_m = metres * math.exp(-s / tau_s)
        return shifted(fix, left_m, math.hypot(STD_M, left_m))

    return changed


@dataclass(frozen=True)
class Fault:
    """What a receiver does, and from when on its fixes are good again [s]."""

    changed: Callable[[list[Reading]], list[Reading]]
    good_s: float


def each(change: Change, good_s: float) -> Fault:
    return Fault(lambda rs: [change(r, since(r)) if isinstance(r, Gps) else r for r in rs], good_s)


def frozen(begin_s: float, end_s: float) -> Fault:
    """A receiver that hangs: it repeats its last fix bit for bit."""

    def changed(readings: list[Reading]) -> list[Reading]:
        last = next(r for r in reversed(readings) if isinstance(r, Gps) and since(r) < begin_s)
        return [
            replace(last, stamp_ns=r.stamp_ns) if isinstance(r, Gps) and begin_s <= since(r) < end_s else r
            for r in readings
        ]

    return Fault(changed, end_s)


def held(readings: list[Reading]) -> list[Reading]:
    """A table at the rate of the IMU, in which each fix of 1 Hz stands until the next."""
    kept: Gps | None = None
    table: list[Reading] = []
    for r in readings:
        if isinstance(r, Gps):
            kept = r if kept is None or r.stamp_ns - kept.stamp_ns >= 10**9 else kept
        else:
            table.append(r)
        if kept and r.sensor == "imu" and r.stamp_ns > kept.stamp_ns:
            table.append(replace(kept, stamp_ns=r.stamp_ns))
    return table


class Faults(Enum):
    """Scenarios, of public reports by users of receivers."""

    OFF_AND_SAYS_SO = each(off(30.0, 6.0, states=True), 6.0)
    OFF_FOR_LONG_AND_SAYS_SO = each(off(60.0, 20.0, states=True), 20.0)
    OFF_AND_SURE = each(off(40.0, 6.0, states=False), 6.0)
    OFF_FOR_LONG_AND_SURE = each(off(25.0, 20.0, states=False), 20.0)
    CONVERGING = each(converging(40.0, 4.0), 16.0)
    FROZEN = frozen(30.0, 70.0)
    FROZEN_FROM_THE_START = frozen(2.0, 25.0)
    HELD = Fault(held, 0.0)


def since(reading: Reading) -> float:
    return (reading.stamp_ns - START_NS) * 1e-9


@cache
def truth() -> Drive:
    return drive(LEGS, machine())


def machine() -> MachineConfig:
    receiver = {"drift_share": SLOW_SHARE, "drift_time_s": SLOW_S}
    sensors = (replace(s, **receiver) if s.kind == "gps" else s for s in VEHICLE.sensors)
    return replace(VEHICLE, sensors=tuple(sensors))


@cache
def measured(seed: int) -> list[Reading]:
    """The drive with the errors of a receiver; a quarter of the fast readings are enough here, and save time."""
    rng, slow_m = np.random.default_rng(seed), math.sqrt(SLOW_SHARE) * STD_M
    readings, error = [], slow_m * rng.standard_normal(2)
    kept = math.exp(-0.2 / SLOW_S)
    for r in noisy(thinned(truth().readings, 40), seed):
        if isinstance(r, Gps):
            error = kept * error + slow_m * math.sqrt(1 - kept**2) * rng.standard_normal(2)
            e, n = error + math.sqrt(1 - SLOW_SHARE) * STD_M * rng.standard_normal(2)
            x, y, z = PROJECTION.to_map(r.lat_deg, r.lon_deg, r.height_m)
            lat, lon, _ = PROJECTION.to_geodetic(x + e, y + n, z)
            r = replace(r, lat_deg=lat, lon_deg=lon, var_e_m2=STD_M**2, var_n_m2=STD_M**2)
        readings.append(r)
    return readings


@dataclass(frozen=True)
class Outcome:
    """Errors [m] and their normalised squares of live poses (n,), their times [s], and errors of final samples (k,)."""

    seconds: Floats
    off_m: Floats
    nees: Floats
    samples_off_m: Floats
    counters: dict[str, int]
    repeating: set[str]


def replayed(readings: Iterable[Reading]) -> Outcome:
    config = PipelineConfig(LocalisationConfig("ekf", slip=0.0, slip_soft=0.0))
    pipeline, poses, made, repeating = Pipeline(SITE, machine(), config), [], [], set()
    for stamp_ns, group in groupby(readings, key=lambda r: r.stamp_ns - r.stamp_ns % 200_000_000):
        made.append(pipeline.step(list(group)))
        poses += [pipeline.pose] if pipeline.pose else []
        if stamp_ns % 1_000_000_000 == 0:
            repeating |= set(pipeline.health()["repeating"])
    made.append(pipeline.finish())
    errors = np.array([(p.x_m, p.y_m) for p in poses]) - [truth().at(p.stamp_ns)[:2] for p in poses]
    nees = np.array([e @ np.linalg.solve(p.covariance_m2, e) for e, p in zip(errors, poses, strict=True)])
    seconds = (np.array([p.stamp_ns for p in poses]) - START_NS) * 1e-9
    final, counters = joined(made).final, pipeline.health()["counters"]
    off_m = np.array([sample_off_m(row) for row in final])
    return Outcome(seconds, np.hypot(*errors.T), nees, off_m, counters, repeating)


def sample_off_m(row: np.void) -> float:
    """How far a sample lies from where the load centre was."""
    x, y, heading = truth().at(int(row["stamp_ns"]))
    ahead = VEHICLE.load_centre_m
    return math.dist((row["x_m"], row["y_m"]), (x + ahead * math.cos(heading), y + ahead * math.sin(heading)))


@cache
def passing(seed: int) -> Outcome:
    return replayed(measured(seed))


@cache
def faulty(fault: Faults) -> Outcome:
    return replayed(fault.value.changed(measured(SEED)))


@pytest.mark.slow
@pytest.mark.parametrize("fault", Faults, ids=lambda fault: fault.name.lower())
def test_positions_recover_and_no_sample_is_far_off(fault: Faults) -> None:
    outcome, without = faulty(fault), passing(SEED)
    later = outcome.seconds > fault.value.good_s + SETTLED_S
    off_m, nees = outcome.off_m[later], outcome.nees[later]
    beside = without.off_m[without.seconds > fault.value.good_s + SETTLED_S]
    figures = f"seed={SEED} rms {rms(off_m):.2f} of {rms(beside):.2f} nees {nees.mean():.2f}"
    assert (nees < 9.0).mean() >= 0.99, figures
    assert nees.mean() <= max(4.0, 1.2 * without.nees.mean()), figures
    assert rms(off_m) <= 1.3 * rms(beside) + 0.3, figures
    assert len(outcome.samples_off_m) > 0.6 * len(without.samples_off_m), figures
    assert (outcome.samples_off_m > 5.0).sum() <= (without.samples_off_m > 5.0).sum(), figures
    assert outcome.samples_off_m.max() < 9.0, figures


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_a_receiver_that_hangs_is_named_and_one_that_does_not_is_not() -> None:
    outcome = faulty(Faults.FROZEN)
    assert outcome.repeating == {"gps-1"}
    assert outcome.counters["gps-1_repeated"] == pytest.approx(40 * 5, abs=2)
    assert passing(SEED).repeating == set()
    assert "gps-1_repeated" not in passing(SEED).counters


def test_a_parked_machine_s_receiver_has_no_fault() -> None:
    """It pins its fix: that is one value, and no fault as long as no wheel turns."""
    made = drive([Leg(20)], VEHICLE)
    pipeline = Pipeline(SITE, VEHICLE, PipelineConfig())
    pipeline.step(made.readings)
    health = pipeline.health()
    assert health["repeating"] == []
    assert "gps-1_repeated" not in health["counters"]
