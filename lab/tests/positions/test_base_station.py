"""The experiment with a base station: what its cases do to the corrections, and when these arrive."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig, Positioning
from lab.positions.base_station import (
    CASES,
    GOALS,
    JUMP_M,
    NUMBER,
    ROWS,
    SHARES,
    BaseCase,
    SharedSite,
    _traces,
    arrivals,
    corrections,
    failing,
)
from lab.positions.substitution import gps_errors
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import Correction, Encoder
from protocol.site.site_config import SiteConfig
from sim.sensors.presets import load_preset
from sim.sensors.rigs import base_config
from sim.simulator import START_NS
from sitegrid.logs.replay import replay
from tests.unit.agents.drives import SITE, Leg, drive, machine

MADE = [Correction("base", START_NS + i * 10**9, float(i), 0.0, 0.1, 1.0, 45.0, 0.0, 0.0, 0.1) for i in range(1, 11)]
MIDDLE_NS = START_NS + 5_500_000_000


def test_every_case_is_a_row_of_both_shares_and_every_goal_has_rows() -> None:
    assert {row.case for row in ROWS if row.site_share == 0.8} == set(CASES)
    for goal in GOALS:
        assert any(goal.row.items() <= {"site_share": r.site_share, "case": r.case}.items() for r in ROWS), goal
    assert [row.case for share in SHARES for row in SharedSite(share).rows if row.site_share != share] == []
    assert {SharedSite(share).rows[0].case for share in SHARES} == {"none"}


def test_case_says_how_far_the_survey_is_off_and_how_long_the_base_stood() -> None:
    assert [BaseCase(0.8, case).survey_off_m for case in ("good", "off_1m", "new_off_5m")] == [0.0, 1.0, 5.0]
    assert BaseCase(0.8, "new").stood_s == 0 < BaseCase(0.8, "good").stood_s


def test_base_fails_from_the_middle_on_and_stamps_go_on() -> None:
    def east(case: str) -> list[float]:
        made = list(failing(MADE, case, MIDDLE_NS))
        assert [c.stamp_ns for c in made] == [c.stamp_ns for c in MADE][: len(made)]
        return [c.east_m for c in made]

    assert east("good") == [float(i) for i in range(1, 11)]
    assert east("dies") == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert east("repeats") == [1.0, 2.0, 3.0, 4.0, 5.0] * 2
    assert east("sticks") == [1.0, 2.0, 3.0, 4.0, *[5.0] * 6]


def test_corrections_arrive_late_and_none_before_the_machine_starts() -> None:
    readings = [Encoder("wheels", START_NS + i * 10**9 + 2 * 10**9, 0.0, 0.0) for i in range(4)]
    got = arrivals(readings, MADE, 0.3)
    assert got[0] is readings[0]
    heard = [r.stamp_ns for r in got if isinstance(r, Correction)]
    assert heard[0] == MADE[1].stamp_ns
    for before, after in itertools.pairwise(got):
        if isinstance(before, Encoder) and isinstance(after, Correction):
            assert after.stamp_ns + 300_000_000 > before.stamp_ns


@pytest.mark.slow
def test_base_of_an_experiment_errs_as_it_should() -> None:
    preset, site = load_preset("paper"), SiteConfig("pit", 49.0, 8.0)
    noise = replace(preset.gps, site_share=0.8, machine_share=0.8)
    base = base_config("base", replace(preset, gps=noise))

    errors = gps_errors(base, noise, 1, START_NS + 20 * 10**9, NUMBER)["gps-1"]

    def east(case: str) -> np.ndarray:
        made = corrections(site, base, noise, errors, BaseCase(0.8, case), START_NS + 10 * 10**9)
        return np.array([(c.stamp_ns, c.east_m) for c in made])

    good, wrong, jumps = east("good"), east("off_2m"), east("jumps")
    assert np.allclose(wrong[:, 1], good[:, 1] - 2.0, atol=1e-3)
    middle = good[:, 0] >= START_NS + 10 * 1e9
    assert np.allclose(jumps[:, 1] - good[:, 1], JUMP_M * middle, atol=1e-3)
    assert np.array_equal(east("good"), good)


@pytest.mark.slow
def test_case_that_goes_on_from_the_middle_is_the_whole_run_to_the_last_bit() -> None:
    vehicle = machine()
    vehicle = replace(vehicle, sensors=(*vehicle.sensors, SensorConfig("base", "correction")))
    driven = drive((Leg(4, 0.5), Leg(6), Leg(6, 0, 0.3), Leg(8)), vehicle)
    middle_ns = driven.readings[0].stamp_ns + 12 * 10**9
    stamps = range(driven.readings[0].stamp_ns, driven.readings[-1].stamp_ns, 200_000_000)
    made = [Correction("base", ns, 0.1 * (i % 7), 0.0, 0.1, 1.0, 45.0, 0.0, 0.0, 0.1) for i, ns in enumerate(stamps)]
    cases = [BaseCase(0.8, case) for case in ("good", "new", "dies", "repeats")]
    heard = {case: arrivals(driven.readings, list(failing(made, case.case, middle_ns)), 0.3) for case in cases}
    config = PipelineConfig(localisation=LocalisationConfig(lag_s=0.0))
    got = {row: (trace, core) for row, trace, core in _traces(Positioning(SITE, vehicle, config), heard, middle_ns)}
    for row, readings in heard.items():
        whole = Positioning(SITE, vehicle, config)
        expected, (trace, core) = replay(whole, readings), got[row]
        assert core.counters == whole.counters
        assert trace.last_ns == expected.last_ns
        assert len(trace.stamp_ns) > 150
        for name in ("stamp_ns", "position_m", "covariance_m2", "heading_rad"):
            assert np.array_equal(getattr(trace, name), getattr(expected, name)), (row.case, name)
    assert got[cases[0]][1].counters["base_used"] > got[cases[2]][1].counters["base_used"] > 0
