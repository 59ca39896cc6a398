"""The picture of a worklist: red where it costs most, grey where nothing is known, and no roads at all."""

from dataclasses import replace

import numpy as np

from mapserver.pictures.worklist import REPAIRED, UNKNOWN, WORST, _notes, draw_worklist
from protocol.queries.roads import decode_segments, decode_worklist
from tests.paths import GOLDEN

ROADS = decode_segments((GOLDEN / "segments.bin").read_bytes())
WORK = decode_worklist((GOLDEN / "worklist.bin").read_bytes())


def count(image, colour) -> int:
    return int((image == np.array(colour, np.uint8)).all(axis=-1).sum())


def test_stretches_have_the_colours_of_their_cost():
    known, spur = ROADS.segments
    roads = replace(ROADS, segments=(known, replace(spur, line=((120.0, 0.0), (150.0, 0.0)))))
    listed, nothing = (
        draw_worklist(roads, replace(WORK, changes=())),
        draw_worklist(roads, replace(WORK, rows=(), changes=())),
    )
    assert count(listed, WORST) > count(nothing, WORST) == 0
    assert count(listed, UNKNOWN) > 100
    assert count(draw_worklist(roads, replace(WORK, rows=())), REPAIRED) > 100


def test_what_became_worse_is_not_green_and_is_said():
    change = WORK.changes[0]
    worse = replace(change, before=change.after, after=change.before, saved_kwh_ph=-change.saved_kwh_ph)
    assert count(draw_worklist(ROADS, replace(WORK, rows=(), changes=(worse,))), REPAIRED) == 0
    notes = _notes(replace(WORK, rows=(), changes=(change, worse)))
    assert notes[-2:] == [
        f"1 repaired since they were known: {change.saved_kwh_ph:.1f} kWh an hour saved",
        f"1 worse since they were known: {change.saved_kwh_ph:.1f} kWh an hour more lost",
    ]
