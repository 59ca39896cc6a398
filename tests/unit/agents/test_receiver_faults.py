"""Receivers off, frozen or repeating: positions recover and nothing wrong reaches the map.

Synthetic drives with slow and white receiver errors; each fault is compared with the faultless drive.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import groupby

import numpy as np
import pytest

from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import joined
from protocol.arrays import Floats
from protocol.machine.readings import Gps, Reading
from tests.unit.agents.drives import PROJECTION, SITE, VEHICLE, Leg, changed_sensor, drive, noisy, seconds, thinned

STD_M, SLOW_SHARE, SLOW_S = 1.2, 0.75, 45.0  # as stated by the receiver and configured
RECEIVER = changed_sensor(VEHICLE, "gps-1", drift_share=SLOW_SHARE, drift_time_s=SLOW_S)
LEGS = (Leg(3), Leg(4, 1.0), Leg(6), *[Leg(5, 0.0, 0.25), Leg(7), Leg(4, 0.0, -0.3), Leg(6)] * 3)  # 79 s
SETTLED_S = 25.0  # of good input
SEED = 1
Fault = Callable[[list[Reading]], list[Reading]]


def shifted(fix: Gps, east_m: float, north_m: float, std_m: float = STD_M) -> Gps:
    x, y, z = PROJECTION.to_map(fix.lat_deg, fix.lon_deg, fix.height_m)
    lat, lon, _ = PROJECTION.to_geodetic(x + east_m, y + north_m, z)
    return replace(fix, lat_deg=lat, lon_deg=lon, var_e_m2=std_m**2, var_n_m2=std_m**2)


def off(metres: Callable[[float], float], *, states: bool) -> Fault:
    """Error by time, as of a receiver just started."""

    def changed(fix: Gps) -> Gps:
        off_m = metres(seconds(fix))
        return shifted(fix, 0.6 * off_m, 0.8 * off_m, math.hypot(STD_M, off_m) if states else STD_M)

    return lambda readings: [changed(r) if isinstance(r, Gps) else r for r in readings]


def frozen(begin_s: float, end_s: float) -> Fault:
    """A frozen receiver repeating its last fix."""

    def changed(readings: list[Reading]) -> list[Reading]:
        last = next(r for r in reversed(readings) if isinstance(r, Gps) and seconds(r) < begin_s)
        return [
            replace(last, stamp_ns=r.stamp_ns) if isinstance(r, Gps) and begin_s <= seconds(r) < end_s else r
            for r in readings
        ]

    return changed


def held(readings: list[Reading]) -> list[Reading]:
    """A table at IMU rate holding each 1 Hz fix until the next."""
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


FAULTS: dict[str, tuple[Fault, float]] = {  # from users' public reports; end of the fault [s]
    "off, and says so": (off(lambda s: 30.0 * (s < 6), states=True), 6.0),
    "off, and sure": (off(lambda s: 25.0 * (s < 20), states=False), 20.0),
    "converging": (off(lambda s: 40.0 * math.exp(-s / 4), states=True), 16.0),
    "frozen": (frozen(20.0, 40.0), 40.0),
    "frozen from the start": (frozen(2.0, 25.0), 25.0),
    "held": (held, 0.0),
}
AT_NIGHT = ("off, and sure", "converging", "frozen from the start")


@cache
def measured() -> list[Reading]:
    """The drive with receiver errors; a quarter of the fast readings, to save time."""
    rng, slow_m = np.random.default_rng(SEED), math.sqrt(SLOW_SHARE) * STD_M
    readings, error = [], slow_m * rng.standard_normal(2)
    kept = math.exp(-0.2 / SLOW_S)
    for r in noisy(thinned(drive(LEGS, RECEIVER).readings, 40), SEED):
        if isinstance(r, Gps):
            error = kept * error + slow_m * math.sqrt(1 - kept**2) * rng.standard_normal(2)
            r = shifted(r, *(error + math.sqrt(1 - SLOW_SHARE) * STD_M * rng.standard_normal(2)).tolist())
        readings.append(r)
    return readings


@dataclass(frozen=True)
class Outcome:
    """Live poses: errors [m], normalised squares (n,), times [s]; errors of final samples (k,)."""

    seconds: Floats
    off_m: Floats
    nees: Floats
    samples_off_m: Floats
    counters: dict[str, int]
    repeating: set[str]


@cache
def replayed(fault: str = "") -> Outcome:
    readings = FAULTS[fault][0](measured()) if fault else measured()
    config, made_up = PipelineConfig(LocalisationConfig("ekf", slip=0.0, slip_soft=0.0)), drive(LEGS, RECEIVER)
    pipeline, poses, made, repeating = Pipeline(SITE, RECEIVER, config), [], [], set()
    for stamp_ns, group in groupby(readings, key=lambda r: r.stamp_ns - r.stamp_ns % 200_000_000):
        made.append(pipeline.step(list(group)))
        poses += [pipeline.pose] if pipeline.pose else []
        if stamp_ns % 1_000_000_000 == 0:
            repeating |= set(pipeline.health()["repeating"])
    made.append(pipeline.finish())
    errors = np.array([(p.x_m, p.y_m) for p in poses]) - [made_up.at(p.stamp_ns)[:2] for p in poses]
    nees = np.array([e @ np.linalg.solve(p.covariance_m2, e) for e, p in zip(errors, poses, strict=True)])
    times_s = np.array([seconds(p) for p in poses])
    final, ahead_m = joined(made).final, VEHICLE.load_centre_m
    true = np.array([made_up.at(stamp_ns) for stamp_ns in final["stamp_ns"].tolist()])
    east_m = final["x_m"] - true[:, 0] - ahead_m * np.cos(true[:, 2])
    north_m = final["y_m"] - true[:, 1] - ahead_m * np.sin(true[:, 2])
    counters = pipeline.health()["counters"]
    return Outcome(times_s, np.hypot(*errors.T), nees, np.hypot(east_m, north_m), counters, repeating)


@pytest.mark.slow
@pytest.mark.parametrize(
    "fault", [pytest.param(name, marks=[pytest.mark.nightly] * (name in AT_NIGHT)) for name in FAULTS]
)
def test_positions_recover_and_no_sample_is_far_off(fault: str) -> None:
    outcome, without, good_s = replayed(fault), replayed(), FAULTS[fault][1]
    later = outcome.seconds > good_s + SETTLED_S
    nees, rms_m = outcome.nees[later], rms(outcome.off_m[later])
    beside_m = rms(without.off_m[without.seconds > good_s + SETTLED_S])
    figures = f"seed={SEED} rms {rms_m:.2f} of {beside_m:.2f} nees {nees.mean():.2f}"
    assert (nees < 9.0).mean() >= 0.99, figures
    assert nees.mean() <= max(4.0, 1.2 * without.nees.mean()), figures
    assert rms_m <= 1.3 * beside_m + 0.3, figures
    assert len(outcome.samples_off_m) > 0.6 * len(without.samples_off_m), figures
    assert (outcome.samples_off_m > 5.0).sum() <= (without.samples_off_m > 5.0).sum(), figures
    assert outcome.samples_off_m.max() < 9.0, figures


def rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_a_receiver_that_hangs_is_named_and_one_that_does_not_is_not() -> None:
    outcome = replayed("frozen")
    assert outcome.repeating == {"gps-1"}
    assert outcome.counters["gps-1_repeated"] == pytest.approx(20 * 5, abs=2)
    assert replayed().repeating == set()
    assert "gps-1_repeated" not in replayed().counters


def test_a_parked_machine_s_receiver_has_no_fault() -> None:
    """It pins its fix; constant values are no fault while no wheel turns."""
    pipeline = Pipeline(SITE, VEHICLE, PipelineConfig())
    pipeline.step(thinned(drive([Leg(20)], VEHICLE).readings))
    health = pipeline.health()
    assert health["repeating"] == []
    assert "gps-1_repeated" not in health["counters"]
