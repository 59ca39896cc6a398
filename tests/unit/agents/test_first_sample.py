"""An agent without samples says in one sentence what is missing, once, in the readings' own time."""

from __future__ import annotations

from dataclasses import replace

import pytest

from agents.first_sample import WAIT_NS, FirstSample
from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from protocol.machine.readings import Encoder, Gps, Reading
from tests.unit.agents.drives import SITE, VEHICLE, Leg, drive, thinned

pytestmark = pytest.mark.slow
NO_SAMPLE = "no sample after 30 s of readings: "
DRIVEN = thinned(drive([Leg(4, 0.5), Leg(32)], VEHICLE).readings)
DRIVEN_FIXES = [reading for reading in DRIVEN if isinstance(reading, Gps)]
STANDING = thinned(drive([Leg(36)], VEHICLE).readings)


def said(readings: list[Reading], config: PipelineConfig | None = None) -> list[str]:
    """All that is said during a stream of readings, one after the other."""
    pipeline, first = Pipeline(SITE, VEHICLE, config or PipelineConfig(LocalisationConfig("ekf"))), FirstSample(VEHICLE)
    sentences = []
    for i in range(0, len(readings), 15):
        bundle = readings[i : i + 15]
        first.take(bundle)
        if len(pipeline.step(bundle).pending):
            first.sampled()
        if sentence := first.judge(pipeline.health):
            assert bundle[-1].stamp_ns - readings[0].stamp_ns >= WAIT_NS
            sentences.append(sentence)
    assert first.why_not == next((s for s in sentences if s.startswith("no sample after")), "")
    return sentences


def without(*kinds: str, readings: list[Reading] = DRIVEN) -> list[Reading]:
    return [reading for reading in readings if reading.kind not in kinds]


NO_WHEELS, NO_TORQUE = "no wheel readings (encoder or odometry)", "no torque readings"
ELSEWHERE = [replace(r, lat_deg=0.0) if isinstance(r, Gps) else r for r in DRIVEN]
STUCK = [replace(DRIVEN_FIXES[0], stamp_ns=r.stamp_ns) if isinstance(r, Gps) else r for r in DRIVEN]
UNKNOWN = [replace(r, sensor=f"x-{r.sensor}") for r in DRIVEN]


@pytest.mark.parametrize(
    ("readings", "missing"),
    [
        (without("gps"), "no GPS fixes"),
        (without("gps", "encoder", "torque"), f"no GPS fixes, {NO_WHEELS}, {NO_TORQUE}"),
        (STANDING, "the heading is unknown until the machine has driven 12 m with GPS fixes"),
        (STUCK, "gps-1 repeats one fix"),
        (ELSEWHERE, "GPS fixes outside the site"),
        (UNKNOWN, f"none of them is of a sensor in the config, {NO_WHEELS}, {NO_TORQUE}"),
    ],
)
def test_what_is_missing_is_said_once(readings: list[Reading], missing: str):
    assert said(readings) == [NO_SAMPLE + missing]


def test_the_proof_of_a_heading_has_its_time():
    stopped = thinned(drive([Leg(20), Leg(4, 0.5), Leg(5), Leg(4, -0.5), Leg(30)], VEHICLE).readings)
    assert said([r for r in stopped if r.stamp_ns < stopped[0].stamp_ns + 2 * WAIT_NS]) == []
    sentence = "no sample after 60 s of readings: the heading is not proven until fixes agree with it for 30 s and 12 m"
    assert said(stopped) == [sentence]


def test_wheels_in_another_unit_are_named():
    driven = thinned(drive([Leg(4, 0.5), Leg(64)], VEHICLE).readings)
    ticks = [
        replace(r, left_ticks=3.6 * r.left_ticks, right_ticks=3.6 * r.right_ticks)
        for r in driven
        if isinstance(r, Encoder)
    ]
    (sentence,) = said(sorted([*ticks, *(r for r in driven if not isinstance(r, Encoder))], key=lambda r: r.stamp_ns))
    assert sentence.endswith(": the wheels turn 3.6 times as far as the fixes go: look at their unit")


def test_a_machine_that_stands_where_it_was_placed_has_not_moved():
    placed = PipelineConfig(LocalisationConfig("ekf", start=(10.0, 20.0, 0.7)))
    assert said(STANDING, placed) == [f"{NO_SAMPLE}the machine has not moved"]


def test_samples_without_resistance_have_their_reason_too():
    assert said(without("torque")) == [f"samples have no rolling resistance: {NO_TORQUE}"]
    parked = without("encoder", readings=[r for r in STANDING if r.stamp_ns < STANDING[-1].stamp_ns])
    heading = "the heading is unknown until the machine has driven 12 m with GPS fixes"
    assert said(parked) == [f"{NO_SAMPLE}{heading}, {NO_WHEELS}"]


def test_nothing_is_said_of_a_machine_that_has_all_nor_before_the_time():
    assert said(DRIVEN) == []
    early = [r for r in STANDING if r.stamp_ns < STANDING[0].stamp_ns + WAIT_NS]
    assert said(early) == []
    assert said([*early[:75], *(replace(r, stamp_ns=r.stamp_ns + WAIT_NS) for r in early[75:])]) == [], "a clock is set"
