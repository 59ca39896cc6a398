"""Far-off stamps and differing clocks in a live agent."""

from __future__ import annotations

import random
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import Accepted, PipelineConfig, Positioning
from agents.sampling import Samples, joined
from agents.status import Status
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Reading
from tests.tiers import by_night
from tests.unit.agents.drives import SITE, START_NS, VEHICLE, Leg, drive, thinned
from tests.unit.agents.test_status import report

SECOND, DAY, YEARS = 10**9, 86_400, 20 * 365 * 86_400
EKF = PipelineConfig(LocalisationConfig("ekf"))
MADE = drive([Leg(4, 0.5), Leg(8), Leg(4, 0, 0.25), Leg(8), Leg(4, 0, -0.3), Leg(32)], VEHICLE)
READINGS = thinned(MADE.readings)
SENSORS = sorted({r.sensor for r in READINGS})
LEAPS_S = (0.0, 0.3, 2.0, 61.0, 3600.0, DAY, YEARS)


def shifted(readings: list[Reading], ahead_s: float, *sensors: str) -> list[Reading]:
    """Stamps of these sensors are ahead; arrivals are unchanged."""
    by_ns = round(ahead_s * SECOND)
    return [replace(r, stamp_ns=r.stamp_ns + by_ns) if r.sensor in sensors else r for r in readings]


def astray(sensor: str, after_s: float, off_s: float, rows: int = 1) -> list[Reading]:
    """Far-off stamps of some rows of one sensor."""
    late = [i for i, r in enumerate(READINGS) if r.sensor == sensor and r.stamp_ns >= START_NS + after_s * SECOND]
    readings = list(READINGS)
    for i in late[:rows]:
        readings[i] = replace(readings[i], stamp_ns=readings[i].stamp_ns + round(off_s * SECOND))
    return readings


def off_m(readings: list[Reading]) -> tuple[np.ndarray, Positioning]:
    """Position errors from 15 s on."""
    located, off = Positioning(SITE, VEHICLE, EKF), []
    for i in range(0, len(readings), 15):
        located.step(readings[i : i + 15])
        if (pose := located.pose) and pose.stamp_ns >= START_NS + 15 * SECOND:
            x_m, y_m, _ = MADE.at(pose.stamp_ns)
            off.append(np.hypot(pose.x_m - x_m, pose.y_m - y_m))
    return np.array(off), located


@cache
def sound() -> tuple[np.ndarray, Positioning]:
    return off_m(READINGS)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensor", "after_s", "off_s", "rows"),
    [
        ("gps-1", 0, YEARS, 1),
        ("imu", 30, DAY, 1),
        ("imu", 30, -DAY, 3),
        ("wheels", 20, 3600, 2),
        ("gps-1", 25, -YEARS, 1),
    ],
)
def test_a_stamp_far_off_is_refused_alone_and_the_track_goes_on(
    sensor: str, after_s: float, off_s: float, rows: int
) -> None:
    (sound_m, located), (off, met) = sound(), off_m(astray(sensor, after_s, off_s, rows))
    assert len(off) > 0.95 * len(sound_m)
    assert off.max() <= max(2 * sound_m.max(), 4.0)
    assert located.counters["reading_ahead"] + located.counters["reading_late"] == 0
    assert met.counters["reading_ahead"] + met.counters["reading_late"] <= rows
    assert met.counters["gap_restarts"] + met.counters["clock_back_restarts"] == 0


def said(readings: list[Reading]) -> tuple[str, str]:
    """Final health, and the sentence on missing samples."""
    pipeline, status = Pipeline(SITE, VEHICLE, EKF), Status(VEHICLE)
    for i in range(0, len(readings), 15):
        status.take(readings[i : i + 15])
        pipeline.step(readings[i : i + 15])
        status.judge(report(pipeline))
    return pipeline.clocks(), status.unsampled


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sensors", "ahead_s", "sentence"),
    [
        (("gps-1",), 18.0, "gps-1 is 18.0 s ahead of imu, torque, wheels: readings are refused, set its clock"),
        (("gps-1",), 2.0, "gps-1 is 1.8 s ahead of imu, torque, wheels: readings are refused, set its clock"),
        (("gps-1",), -2.0, "gps-1 is 2.0 s behind imu, torque, wheels: readings are refused, set its clock, or"),
        (("imu", "wheels", "torque"), -1.7e9, "gps-1 is 1700000000.0 s ahead of imu, torque, wheels: readings"),
        (("wheels",), 3600.0, "wheels is 3600.0 s ahead of gps-1, imu, torque: readings are refused, set its"),
    ],
)
def test_clocks_that_are_apart_are_why_there_is_no_sample(
    sensors: tuple[str, ...], ahead_s: float, sentence: str
) -> None:
    clocks, no_sample = said(shifted(READINGS, ahead_s, *sensors))
    assert clocks.startswith(sentence)
    assert f" s of readings: {sentence}" in no_sample


@pytest.mark.slow
def test_an_offset_that_refuses_nothing_is_named_by_the_motion() -> None:
    """Fixes come in order, but show the place of two seconds before."""
    legs = [Leg(5, 0.6), Leg(6, 0, 0.2), Leg(3, -1.0), Leg(4), Leg(7, 0.4, -0.2), Leg(5), Leg(7, -0.4), Leg(3)]
    readings = thinned(drive(legs * 2, VEHICLE).readings)
    late = sorted(shifted(readings, 2.0, "gps-1"), key=lambda r: r.stamp_ns)
    for stream, clocks in ((late, "gps-1 is 2.0 s ahead of imu, wheels: set its clock"), (readings, "")):
        pipeline = Pipeline(SITE, VEHICLE, EKF)
        pipeline.step([r for r in stream if r.sensor != "torque"])
        assert pipeline.clocks() == clocks


def test_a_live_agent_says_why_it_takes_no_larger_delay() -> None:
    with pytest.raises(ValueError, match=r"gps-1: delay_s must be between -10 and 0\.4: a live agent cannot wait"):
        SensorConfig("gps-1", "gps", delay_s=18.0)


class WatchedPipeline(Pipeline):
    """Counts used readings and keeps those at the last restart."""

    accepted = 0
    restarted: tuple[Reading, ...] = ()

    def _take_one(self, accepted: Accepted) -> list[Samples]:
        self.accepted += len(accepted.readings)
        if accepted.restarts:
            self.restarted = tuple(reading for reading, _ in accepted.readings)
        return super()._take_one(accepted)


def leaping(rng: random.Random) -> list[Reading]:
    """The clock of all sensors, or of one, is set repeatedly."""
    off_s, leaps, readings = dict.fromkeys(SENSORS, 0.0), set(rng.sample(range(len(READINGS)), 5)), []
    for i, reading in enumerate(READINGS):
        if i in leaps:
            off_s |= dict.fromkeys(rng.choice((SENSORS, SENSORS, [rng.choice(SENSORS)])), rng.choice(LEAPS_S))
            off_s = {name: rng.choice((-1, 1)) * s if rng.random() < 0.5 else s for name, s in off_s.items()}
        readings += shifted([reading], off_s[reading.sensor], reading.sensor)
    return readings


@pytest.mark.slow
@pytest.mark.parametrize("seed", by_night(range(10), day=range(3)))
def test_clocks_that_leap_never_end_an_agent(seed: int) -> None:
    """Each reading is used or counted as refused; each sample has a place and covariance."""
    readings, pipeline = leaping(random.Random(seed)), WatchedPipeline(SITE, VEHICLE, EKF)
    made = [pipeline.step(readings[i : i + 15]) for i in range(0, len(readings), 15)]
    pipeline.clocks()
    for rows in joined([*made, pipeline.finish()]):
        xx, xy, yy = (rows[f"cov_{axes}_m2"] for axes in ("xx", "xy", "yy"))
        assert all(np.isfinite(rows[name]).all() for name in ("x_m", "y_m", "heading_rad", "speed_mps"))
        assert ((xx > 0) & (xx * yy > xy**2)).all()
    counters = pipeline.health()["counters"]
    refused = sum(counters.get(f"reading_{why}", 0) for why in ("late", "ahead", "duplicate"))
    assert pipeline.accepted + refused == len(readings)


@pytest.mark.slow
@pytest.mark.parametrize("leap_s", by_night([-3600.0, 3600.0, -DAY], day=[-3600.0]))
def test_a_clock_that_was_set_is_a_start_anew(leap_s: float) -> None:
    """Nothing older counts: samples equal those of an agent starting there, bit for bit."""
    before, after = READINGS[:1500], iter(shifted(READINGS[1500:], leap_s, *SENSORS))
    pipeline = WatchedPipeline(SITE, VEHICLE, EKF)
    pipeline.step(before)
    while not pipeline.restarted:
        pipeline.step([held := next(after)])
    fresh, rest = Pipeline(SITE, VEHICLE, EKF, pipeline.calibration), list(after)
    fresh.step([*pipeline.restarted, held])
    made, expected = (joined([each.step(rest), each.finish()]) for each in (pipeline, fresh))
    assert len(expected.final) > 20
    for rows, right in zip(made, expected, strict=True):
        assert np.array_equal(rows[-len(right) :].view(np.uint8), right.view(np.uint8))
