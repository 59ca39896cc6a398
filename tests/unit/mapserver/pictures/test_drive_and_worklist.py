"""Pictures of a drive along its line, and of a worklist."""

from dataclasses import replace

import numpy as np

from mapserver.pictures import profile, worklist
from mapserver.pictures.plotter import draw_resistance
from mapserver.pictures.profile import LINE, draw_drive
from mapserver.pictures.worklist import REPAIRED, WORST, draw_worklist
from protocol.queries.answers import Region
from protocol.queries.roads import decode_segments, decode_worklist
from protocol.queries.routing import decode_answer
from tests.paths import GOLDEN
from tests.unit.records import version

DRIVE = decode_answer((GOLDEN / "route.bin").read_bytes())
REGION = Region(
    np.arange(40) + 0.5, np.arange(50) + 0.5, 1.0, {"resistance": np.full((50, 40), 0.02, np.float32)}, version(), 0
)


def count(image, colour) -> int:
    return int((image == np.array(colour, np.uint8)).all(axis=-1).sum())


def test_a_drive_is_drawn_on_the_map_and_along_its_way():
    picture, map_alone = draw_drive(REGION, DRIVE), draw_resistance(REGION)
    assert picture.shape[0] > map_alone.shape[0] + 400
    below = picture[map_alone.shape[0] :]
    assert count(below, LINE) > 1000
    assert count(map_alone, LINE) == 0


def test_unknown_ground_is_grey_in_the_profile():
    steps = DRIVE.steps
    known, half = (
        draw_drive(REGION, replace(DRIVE, steps=replace(steps, unknown=np.array(unknown))))
        for unknown in ([0, 0], [0, 1])
    )
    assert count(half, profile.UNKNOWN) > count(known, profile.UNKNOWN) + 10_000


ROADS = decode_segments((GOLDEN / "segments.bin").read_bytes())
WORK = decode_worklist((GOLDEN / "worklist.bin").read_bytes())


def test_stretches_have_the_colours_of_their_cost():
    known, spur = ROADS.segments
    roads = replace(ROADS, segments=(known, replace(spur, line=((120.0, 0.0), (150.0, 0.0)))))
    unchanged = replace(WORK, changes=())
    listed, nothing = (draw_worklist(roads, work) for work in (unchanged, replace(unchanged, rows=())))
    assert count(listed, WORST) > count(nothing, WORST) == 0
    assert count(listed, worklist.UNKNOWN) > 100
    assert count(draw_worklist(roads, replace(WORK, rows=())), REPAIRED) > 100


def test_what_became_worse_is_not_green():
    change = WORK.changes[0]
    worse = replace(change, before=change.after, after=change.before, saved_kwh_ph=-change.saved_kwh_ph)
    assert count(draw_worklist(ROADS, replace(WORK, rows=(), changes=(worse,))), REPAIRED) == 0


def test_losses_an_hour_need_half_an_hour_of_traffic() -> None:
    early, late = (replace(WORK, hours=hours) for hours in (0.2, 2.0))
    title, *notes = (worklist._title(early), *worklist._notes(early))
    assert "from 12 min of traffic" in title
    assert not any("kWh" in words for words in (title, *notes))
    assert "kWh an hour lost" in worklist._title(late)
    assert any("kWh/h" in words for words in worklist._notes(late))
