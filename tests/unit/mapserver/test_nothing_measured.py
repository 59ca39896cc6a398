"""Samples with only a position count as driven and do no harm."""

import numpy as np

from mapserver.calibration.calibrate import calibrate
from mapserver.calibration.ledger import StayLedger
from mapserver.trust.auditor import Auditor
from protocol.machine.samples import GRADE, RESISTANCE
from tests.unit.mapserver.roads.drives import along, passes

LINE = along([(10, 10), (110, 10)])


def nothing_measured(rows):
    rows = rows.copy()
    for name in (*RESISTANCE, *GRADE):
        rows[name] = np.nan
    return rows


def test_a_machine_that_sends_nothing_else_is_not_judged_and_accuses_nobody():
    auditor = Auditor(1.0)
    for name in ("a", "b", "c"):
        auditor.add(name, passes(LINE, 20, seed=ord(name)))
    alone = auditor.verdicts()
    auditor.add("blind", nothing_measured(passes(LINE, 20)))
    together = auditor.verdicts()
    assert not together["blind"].contradicts
    assert {name: together[name].contradicts for name in alone} == {name: alone[name].contradicts for name in alone}
    assert together["blind"].evidence["cells"] == 0


def test_calibration_learns_nothing_from_them():
    true = StayLedger()
    true.add(passes(LINE, 20))
    blind = StayLedger()
    blind.add(nothing_measured(passes(LINE, 20)))
    assert not len(blind.stays())
    with_blind = calibrate({"a": true.stays(), "blind": blind.stays()})
    assert [each for each in with_blind.corrections if each.machine == "a"] == list(
        calibrate({"a": true.stays()}).corrections
    )
