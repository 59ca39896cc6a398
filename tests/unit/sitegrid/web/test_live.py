"""What a live page is sent: parts of a difference, none large, safe to leave in between."""

from __future__ import annotations

from dataclasses import replace

from protocol.queries.answers import MapVersion
from protocol.queries.map_tiles import MapTile, TilesAnswer
from sitegrid.web.live import PART_BYTES, parts_of

BEFORE, NOW = MapVersion("store", 7, 1), MapVersion("store", 9, 2)
TILES = tuple(MapTile(x, 0, 9, 2, 1, bytes(20_000)) for x in range(100))
ANSWER = TilesAnswer(NOW, 1, 1.0, whole=False, tiles=TILES)


def test_a_difference_comes_in_small_parts_of_the_version_before_but_the_last():
    parts = list(parts_of(ANSWER, BEFORE))
    assert tuple(tile for part in parts for tile in part.tiles) == TILES
    assert max(sum(len(tile.planes) for tile in part.tiles) for part in parts) < PART_BYTES + 20_000
    assert [part.version for part in parts] == [BEFORE] * (len(parts) - 1) + [NOW]
    assert len(parts) > 5
    assert not any(part.whole for part in parts)


def test_a_whole_map_begins_anew_once_and_is_asked_for_again_by_a_page_that_left():
    first, *others = parts_of(replace(ANSWER, whole=True), BEFORE)
    assert first.whole
    assert not any(part.whole for part in others)
    assert {part.version for part in (first, *others[:-1])} == {MapVersion("store", 0, 0)}


def test_nothing_is_a_part_too():
    empty = replace(ANSWER, whole=True, tiles=())
    assert list(parts_of(empty, None)) == [empty]
