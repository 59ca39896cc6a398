"""Planted faults: written ones match once in the product, drawn ones leave parsable Python."""

from __future__ import annotations

import ast

from tests.paths import ROOT
from tests.planted.faults import drawn, written


def test_every_fault_by_hand_stands_once() -> None:
    faults = written()
    assert len(faults) == 60
    assert [fault.name for fault in faults if fault.place(ROOT) is None] == []


def test_drawn_faults_change_one_place_and_can_be_read() -> None:
    faults = drawn(ROOT, ROOT, 60, 1)
    assert len({fault.name for fault in faults}) == 60
    for fault in faults:
        place = fault.place(ROOT)
        assert place is not None, fault.name
        text = place.path.read_bytes()
        changed = text[: place.start] + place.text + text[place.end :]
        assert ast.dump(ast.parse(changed)) != ast.dump(ast.parse(text)), fault.what
