from dataclasses import replace

import numpy as np
import pytest

from protocol.errors import MessageError
from protocol.queries.answer_codec import decode_region, encode_region
from protocol.queries.answers import MapVersion, Piece, Region
from sitegrid.whole_answers import joined

VERSION = MapVersion("0123456789abcdef", 7, 0)


def piece(number: int, **changes) -> Region:
    """One of two pieces of a 3 x 2 region: two columns, then one."""
    column, columns = (0, 2) if number == 0 else (2, 1)
    values = np.arange(6, dtype=np.float32).reshape(2, 3)[:, column : column + columns]
    place = replace(Piece(9, number, 2, column, 0, 3, 2), **changes)
    return Region(10.5 + column + np.arange(columns), 0.5 + np.arange(2), 1.0, {"visits": values}, VERSION, 5, place)


def test_pieces_are_joined():
    region = joined([piece(0), piece(1)])
    assert region.piece is None
    assert region["visits"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert (region.x_m.tolist(), region.y_m.tolist()) == ([10.5, 11.5, 12.5], [0.5, 1.5])
    assert (region.version, region.stamp_ns) == (VERSION, 5)


@pytest.mark.parametrize(
    "second",
    [
        piece(0),
        piece(1, cursor=8),
        piece(1, count=3),
        replace(piece(1), version=replace(VERSION, row=8)),
        replace(piece(1), stamp_ns=6),
        replace(piece(1), layers={"weight": piece(1)["visits"]}),
    ],
)
def test_pieces_of_two_maps_are_not_joined(second):
    with pytest.raises(MessageError, match="does not follow"):
        joined([piece(0), second])


def test_a_missing_piece_is_seen():
    with pytest.raises(MessageError, match="4 of 3 x 2 cells"):
        joined([piece(0)])


@pytest.mark.parametrize("changes", [{"column": 3}, {"row": -1}, {"number": 2}, {"columns": 10**9}, {"rows": 1}])
def test_a_piece_outside_of_its_region_is_refused(changes):
    with pytest.raises(MessageError, match="piece"):
        decode_region(encode_region(replace(piece(1), piece=replace(piece(1).piece, **changes))))
