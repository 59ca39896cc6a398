"""What the doctor makes of a base station's correction."""

from __future__ import annotations

from dataclasses import replace

from protocol.errors import MessageError, Refusal
from protocol.machine.readings import Correction
from sitegrid.doctor import Level
from sitegrid.doctor.base import check_base

CORRECTION = Correction("base-1", 1_750_000_000_000_000_000, 1.0, -1.0, 0.1, 1.0, 45.0, 0.2, -0.1, 0.09)


def test_base_at_its_place_is_fine() -> None:
    finding = check_base(CORRECTION)
    assert finding.level is Level.PASS
    assert "base-1 publishes corrections" in str(finding)


def test_survey_that_is_off_is_named_with_its_direction() -> None:
    finding = check_base(replace(CORRECTION, offset_e_m=-5.0))
    assert finding.level is Level.WARN
    assert "-5.0 m east" in str(finding)
    assert "check `place`" in str(finding)
    unsure = check_base(replace(CORRECTION, offset_e_m=-5.0, offset_m2=9.0))
    assert unsure.level is Level.PASS  # a base that has just begun does not know yet


def test_correction_that_is_refused_is_a_fault_and_silence_is_none() -> None:
    assert check_base(MessageError(Refusal.WRONG_FRAME, "another frame")).level is Level.FAIL
    assert check_base(None).level is Level.SKIP
