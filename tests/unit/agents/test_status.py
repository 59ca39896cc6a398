"""An agent's problems: worst first, one sentence each; missing data by the readings' time."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from functools import cache
from typing import Any

import pytest

from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.status import DRAWS, SILENT_S, WAIT_NS, Hindrance, Status, described
from protocol.machine.machine_config import SensorConfig
from protocol.machine.powertrain_config import PowertrainConfig
from protocol.machine.readings import Encoder, Engine, Gps, Reading
from tests.unit.agents.drives import SITE, VEHICLE, Leg, drive, thinned

pytestmark = pytest.mark.slow
DRIVEN = thinned(drive([Leg(4, 0.5), Leg(32)], VEHICLE).readings)
DRIVEN_FIXES = [reading for reading in DRIVEN if isinstance(reading, Gps)]
STANDING = thinned(drive([Leg(36)], VEHICLE).readings)


SPOOL = {"depth": 0, "pending": 0, "dropped": 0, "given_up": 0, "unsaved": 0}


def report(pipeline: Pipeline, **known: Any) -> dict[str, Any]:
    """For an agent without other problems."""
    parts = {"driver_problems": [], "spool_problem": "", "spool_damage": "", "calibration_problem": "", "silent_s": 0.0}
    rest = {"corrections": None, "record": None, "uplink": {"problem": ""}, "spool": SPOOL, "acknowledged": 0}
    return {**parts, **rest, "pipeline": pipeline.health(), "clocks": pipeline.clocks(), **known}


def followed(readings: list[Reading], config: PipelineConfig | None = None) -> tuple[Pipeline, Status, list[str]]:
    """After a stream of readings, with all sentences on missing samples."""
    pipeline, status = Pipeline(SITE, VEHICLE, config or PipelineConfig(LocalisationConfig("ekf"))), Status(VEHICLE)
    sentences: list[str] = []
    for i in range(0, len(readings), 15):
        bundle = readings[i : i + 15]
        status.take(bundle)
        if len(pipeline.step(bundle).pending):
            status.sampled()
        status.judge(report(pipeline))
        if status.unsampled:
            assert bundle[-1].stamp_ns - readings[0].stamp_ns >= WAIT_NS
            sentences.append(status.unsampled.split(": ", 1)[1])
    return pipeline, status, list(dict.fromkeys(sentences))


def said(readings: list[Reading], config: PipelineConfig | None = None) -> list[str]:
    return followed(readings, config)[2]


def without(*kinds: str, readings: list[Reading] = DRIVEN) -> list[Reading]:
    return [reading for reading in readings if reading.kind not in kinds]


@cache
def followed_without(*kinds: str) -> tuple[Pipeline, Status]:
    """After the drive; not changed by tests."""
    return followed(without(*kinds))[:2]


HEADING = "the heading is unknown until the machine has driven 12 m with GPS fixes"
ELSEWHERE = [replace(r, lat_deg=0.0) if isinstance(r, Gps) else r for r in DRIVEN]
STUCK = [replace(DRIVEN_FIXES[0], stamp_ns=r.stamp_ns) if isinstance(r, Gps) else r for r in DRIVEN]
UNKNOWN = [replace(r, sensor=f"x-{r.sensor}") for r in DRIVEN]


@pytest.mark.parametrize(
    ("readings", "missing"),
    [
        (without("gps"), "no GPS fixes"),
        (
            without("encoder", readings=STANDING),
            "no wheel speeds and no Doppler velocity: " + HEADING.replace("12 m", "60 m"),
        ),
        (STANDING, HEADING),
        (STUCK, "gps-1 repeats one fix"),
        (ELSEWHERE, "GPS fixes are outside the site"),
        (UNKNOWN, "no reading is of a sensor in the config"),
    ],
)
def test_what_is_missing_is_said_once(readings: list[Reading], missing: str):
    assert said(readings) == [missing]


def test_the_proof_of_a_heading_has_its_time():
    stopped = thinned(drive([Leg(20), Leg(4, 0.5), Leg(5), Leg(4, -0.5), Leg(30)], VEHICLE).readings)
    assert said([r for r in stopped if r.stamp_ns < stopped[0].stamp_ns + 2 * WAIT_NS]) == []
    assert said(stopped) == ["the heading is not proven until fixes agree with it for 30 s and 12 m"]


def test_wheels_in_another_unit_are_named():
    driven = thinned(drive([Leg(4, 0.5), Leg(64)], VEHICLE).readings)
    ticks = [
        replace(r, left_ticks=3.6 * r.left_ticks, right_ticks=3.6 * r.right_ticks)
        for r in driven
        if isinstance(r, Encoder)
    ]
    (sentence,) = said(sorted([*ticks, *(r for r in driven if not isinstance(r, Encoder))], key=lambda r: r.stamp_ns))
    assert sentence == "the wheels turn 3.6 times as far as the fixes go: look at their unit"


def test_a_machine_that_stands_where_it_was_placed_has_not_moved():
    placed = PipelineConfig(LocalisationConfig("ekf", start=(10.0, 20.0, 0.7)))
    assert said(STANDING, placed) == ["the machine has not moved"]


LACKS = "no torque: slope only"
WAITING = SPOOL | {"depth": 312}


@pytest.mark.parametrize(
    ("kinds", "known", "sentence", "problems"),
    [
        ((), {}, "calibrating: drive a closed loop, or reverse over your own track", []),
        (("torque",), {}, LACKS, [LACKS]),  # a silent torque sensor
        (("imu",), {}, "no accelerations: track only", ["no accelerations: track only"]),
        ((), {"silent_s": SILENT_S + 1}, "no readings for 11 s: is the machine off?", []),
        ((), {"silent_s": SILENT_S + 1, "driver_problems": ["tty: unplugged"]}, "tty: unplugged", ["tty: unplugged"]),
        ((), {"uplink": {"problem": "no answer"}}, "no answer", ["no answer"]),
        (
            ("torque",),
            {"uplink": {"problem": "no answer"}, "spool": WAITING, "corrections": {"problem": "base-1: old"}},
            "samples wait for the map server (312 held): no answer",
            ["samples wait for the map server (312 held): no answer", "base-1: old", LACKS],
        ),
    ],
)
def test_the_worst_hindrance_is_said_and_what_to_mend_is_listed(kinds, known, sentence: str, problems: list[str]):
    pipeline, heard = followed_without(*kinds)
    status = deepcopy(heard)
    status.sampled()
    shown = described(status.judge(report(pipeline, **{"acknowledged": 1, **known})))
    assert (shown["status"], shown["problems"]) == (sentence, problems)


def test_before_anything_came_in_what_its_drivers_say_counts():
    nothing, status = Pipeline(SITE, VEHICLE, PipelineConfig()), Status(VEHICLE)
    assert status.judge(report(nothing)) == [Hindrance("waiting for the first readings", is_problem=False)]
    undated = "readings wait for UTC: no receiver has stated date and time"
    assert status.judge(report(nothing, driver_problems=[undated]))[0] == Hindrance(undated)
    assert described([])["status"] == DRAWS


def test_nothing_is_said_of_a_machine_that_has_all_nor_before_the_time():
    assert said(DRIVEN) == []
    early = [r for r in STANDING if r.stamp_ns < STANDING[0].stamp_ns + WAIT_NS]
    assert said(early) == []
    assert said([*early[:75], *(replace(r, stamp_ns=r.stamp_ns + WAIT_NS) for r in early[75:])]) == [], "a clock is set"


@pytest.mark.parametrize(
    ("scale", "std", "looks"), [(0.1, 0.02, "10 % too high"), (-0.2, 0.05, "20 % too low"), (0.1, 0.04, "")]
)
def test_torque_by_an_engine_is_torque_and_a_reference_that_is_wrong_is_one_sentence(scale, std, looks: str):
    """A machine on CAN without wheel torque lacks nothing."""
    pipeline, status, _ = followed(without("torque"))
    on_bus = replace(
        VEHICLE, powertrain=PowertrainConfig(2000.0), sensors=(*VEHICLE.sensors, SensorConfig("engine", "engine"))
    )
    known, status = report(pipeline, acknowledged=1), Status(on_bus)
    status.take([*DRIVEN, Engine("engine", DRIVEN[-1].stamp_ns, 0.5, 150.0)])
    status.sampled()
    known["pipeline"]["ground"]["fault"] = ""
    known["pipeline"]["ground"]["calibration"] |= {"scale": scale, "scale_std": std, "zero_std": 0.0}
    sentences = [hindrance.sentence for hindrance in status.judge(known)]
    wrong = f"reference_torque_nm looks {looks}: compare it with the engine's plate, and `mass_kg`"
    assert sentences == ([wrong] if looks else [])
