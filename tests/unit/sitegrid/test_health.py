"""Agent health in words for terminal, end and pages, whatever it holds."""

from __future__ import annotations

import math

import pytest

from sitegrid.health import MOST_CHARS, MOST_PROBLEMS, line_of, problems_of, report_of, status_of, summary_of

SAYS = "no torque: slope only"
REPORT = {
    "status": SAYS,
    "problems": [],
    "readings": 398,
    "samples": 312,
    "acknowledged": 280,
    "pipeline": {"position_std_m": 0.8, "speed_mps": -1.94},
    "spool": {"depth": 32, "unsaved": 0},
    "holdout": None,
}
NOTHING = {"samples": 0, "acknowledged": 0, "spool": {"depth": 0, "unsaved": 0}}
NOWHERE = {"pipeline": {"position_std_m": None, "speed_mps": None}}


def test_one_line_has_place_speed_samples_and_the_sentence():
    assert line_of("loader-1", REPORT) == f"loader-1  +-0.80 m  1.9 m/s  312 samples, 280 delivered  {SAYS}"
    assert line_of("loader-1", REPORT | NOTHING | NOWHERE) == f"loader-1  no place  {SAYS}"


@pytest.mark.parametrize(
    ("known", "sentences"),
    [
        ({}, "312 samples. 32 samples wait in the spool; the next start sends them. No torque: slope only."),
        ({"spool": {"depth": 0, "unsaved": 0}}, "312 samples. All are at the map server."),
        (NOTHING | NOWHERE, "no samples. No torque: slope only."),
        (
            {"samples": 1, "spool": {"depth": 0, "unsaved": 1}},
            "1 sample. 1 sample waits in the spool; the next start sends it. No torque: slope only.",
        ),
    ],
)
def test_a_run_ends_in_sentences_with_a_reason(known, sentences: str):
    assert summary_of("loader-1", REPORT | known) == f"loader-1: 398 readings, {sentences}"


def test_what_others_say_may_be_anything():
    strange = {"status": 7, "problems": "?", "pipeline": 1, "spool": [], "corrections": None, "samples": math.nan}
    for values in ({}, strange):
        assert (status_of(values), problems_of(values)) == ("", [])
        assert set(map(str, report_of(values).values())) == {"", "[]", "None"}
    many = problems_of({"problems": ["a\n\x1b[2Jb " + 10 * MOST_CHARS * "x"] * 99})
    assert len(many) == MOST_PROBLEMS
    assert many[0].startswith("a [2Jb xxx")
    assert len(many[0]) == MOST_CHARS
