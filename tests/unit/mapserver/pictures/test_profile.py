"""The picture of a drive: the map above, and what lies along the line below it."""

from dataclasses import replace

import numpy as np

from mapserver.pictures.plotter import draw_resistance
from mapserver.pictures.profile import LINE, UNKNOWN, draw_drive
from protocol.queries.answers import Region
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
    assert count(half, UNKNOWN) > count(known, UNKNOWN) + 10_000
