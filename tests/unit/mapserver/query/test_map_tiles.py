from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest

from mapserver.query.answering import Answers
from protocol.errors import Refusal
from protocol.queries.answers import MapVersion
from protocol.queries.map_tiles import PLANES, TILE_CELLS, MapTile, TilesAnswer, TilesQuery, decode_tiles, encode_tiles
from protocol.queries.requests import PointQuery, RegionQuery, WhyQuery, parse_query
from protocol.site.geometry import Bounds
from tests.unit.mapserver.data import NOW_NS, SITE, incoming, open_writer, random_samples, refused, samples, send
from tests.unit.mapserver.query.fake_upkeep import answers_of


def content(tiles: dict[tuple[int, int], MapTile]) -> dict[tuple[int, int], tuple[int, bytes]]:
    return {place: (tile.newest_ns, tile.planes) for place, tile in tiles.items()}


class Page:
    """A page drawing the map from its received tiles."""

    def __init__(self, answers: Answers) -> None:
        self.answers = answers
        self.version: MapVersion | None = None
        self.tiles: dict[tuple[int, int], MapTile] = {}

    def ask(self) -> TilesAnswer:
        answer = decode_tiles(encode_tiles(self.answers.tiles(TilesQuery(self.version))))
        if answer.whole:
            self.tiles.clear()
        for tile in answer.tiles:
            known = self.tiles.get((tile.x, tile.y))
            assert known is None or (tile.row, tile.fact) >= (known.row, known.fact), "a tile went back"
            self.tiles[tile.x, tile.y] = tile
        self.version = answer.version
        return answer


def test_tiles_say_what_a_region_says(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(random_samples(4000, seed=3))])
        answers = answers_of(writer)
        page = Page(answers)
        answer = page.ask()
        assert answer.whole
        assert answer.version == answers.point(PointQuery(0, 0)).version
        assert {(tile.x, tile.y) for tile in answer.tiles} == {(-1, -1), (-1, 0), (0, -1), (0, 0)}
        for tile in answer.tiles:
            side = TILE_CELLS * SITE.cell_m
            bounds = Bounds(tile.x * side, tile.y * side, (tile.x + 1) * side, (tile.y + 1) * side)
            region = answers.region(RegionQuery(bounds, (*list(PLANES)[:-1], "age_s")))
            for name, plane in tile.unpacked().items():
                layer = region["age_s"] - (answer.stamp_ns - tile.newest_ns) / 1e9 if name == "since" else region[name]
                shown = PLANES[name].values()[plane]
                known = ~np.isnan(layer)
                assert np.array_equal(known, ~np.isnan(shown)), name
                steps = PLANES[name].values()[1:]
                step = np.gradient(steps)[plane[known].astype(int) - 1]
                within = np.clip(layer, steps[0], steps[-1])
                assert (abs(shown - within)[known] <= 0.75 * step + 1e-6).all(), name


def test_a_page_that_asks_for_what_changed_has_what_a_fresh_one_has(tmp_path):
    rng = np.random.default_rng(1)
    with closing(open_writer(tmp_path)) as writer:
        answers = answers_of(writer)
        page = Page(answers)
        for turn in range(6):
            rows = random_samples(60, seed=turn, half_m=10.0)
            rows["x_m"] += rng.uniform(-150, 150)
            rows["stamp_ns"] += turn * 400 * 10**9
            page.ask()
            send(writer, [incoming(rows, first_seq=1 + 60 * turn)])
            page.ask()
            fresh = Page(answers_of(writer))
            fresh.ask()
            assert content(page.tiles) == content(fresh.tiles)
        assert not page.ask().tiles, "nothing came in: nothing is sent"
        assert page.version is not None
        assert page.version.row == 6


def test_a_change_of_the_ground_reaches_the_tiles(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        answers = answers_of(writer)
        page = Page(answers)
        strip = np.arange(0, 40, 0.5)
        for turn in range(8):
            rows = samples(len(strip), x_m=strip, y_m=8.5, heading_rad=np.pi / 2, cov_xx_m2=1.0, cov_yy_m2=1.0)
            rows["c_rr"] = 0.25 if turn > 3 else 0.02
            rows["stamp_ns"] = NOW_NS + turn * 900 * 10**9 + np.arange(len(strip)) * 10**8
            send(writer, [incoming(rows, first_seq=1 + turn * len(strip))])
            page.ask()
        send(writer, [incoming(samples(5, x_m=200.0), machine="truck-2")])
        value = PLANES["resistance"].values()[page.tiles[0, 0].unpacked()["resistance"]][8, 20]
        why, point = answers.why(WhyQuery(20.5, 8.5)), answers.point(PointQuery(20.5, 8.5))
        assert value == pytest.approx(point.values["resistance"], rel=0.01)
        assert why.metres == pytest.approx(point.values["weight"])
        assert sum(why.resistance.votes) == pytest.approx(why.metres, rel=0.01)
        assert np.argmax(why.sectors) == 4, "all drove north"
        assert why.changed_ns
        assert why.values["resistance"] == pytest.approx(0.25, rel=0.2)
        assert why.before["resistance"] == pytest.approx(0.02, rel=0.2)
        assert sum(why.resistance.before) > 0
        assert why.machines == ("a",)


def test_another_store_or_a_version_that_is_not_there_yet_gets_everything(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(samples(3))])
        answers = answers_of(writer)
        version = answers.tiles(TilesQuery()).version
        assert not answers.tiles(TilesQuery(version)).whole
        for other in (MapVersion("other", 1, 0), MapVersion(version.store, 2, 0), MapVersion(version.store, 1, 5)):
            assert answers.tiles(TilesQuery(other)).whole
            assert len(answers.tiles(TilesQuery(other)).tiles) == 1


def test_tiles_as_of_a_time_are_those_of_that_time(tmp_path):
    early, late = samples(20, c_rr=0.02), samples(20, x_m=30.5, stamp_ns=NOW_NS + 3600 * 10**9)
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(early)])
        answers = answers_of(writer)
        before = Page(answers)
        before.ask()
        send(writer, [incoming(late, first_seq=21)])
        past = answers.tiles(TilesQuery(as_of_ns=NOW_NS + 1000 * 10**9))
        assert content({(tile.x, tile.y): tile for tile in past.tiles}) == content(before.tiles)
        assert past.whole
        assert past.stamp_ns == NOW_NS + 1000 * 10**9


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"store": "a", "row": "1"}, Refusal.MISSING_FIELD),
        ({"store": "a", "row": "-1", "fact": "0"}, Refusal.OUT_OF_RANGE),
        ({"store": "a", "row": "x", "fact": "0"}, Refusal.WRONG_TYPE),
        ({"store": "a", "row": "1", "fact": "0", "as_of": "5"}, Refusal.OUT_OF_RANGE),
        ({"place": "1,2.5"}, Refusal.OUT_OF_RANGE),
    ],
)
def test_a_wrong_version_is_refused_by_name(parameters, reason):
    with refused(reason):
        parse_query("tiles", parameters)


def test_an_empty_map_has_no_tiles_and_no_reasons(tmp_path):
    with closing(open_writer(tmp_path)) as writer:
        answers = answers_of(writer)
        assert answers.tiles(TilesQuery()).tiles == ()
        assert answers.tiles(TilesQuery(as_of_ns=NOW_NS)).tiles == ()
        why = answers.why(WhyQuery(3.5, -2.5))
        assert (why.metres, why.machines, why.newest_ns) == (0.0, (), 0)
        assert set(why.values.values()) == {None}


def test_a_large_map_comes_in_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr("mapserver.query.map_tiles.PIECE_BYTES", 3000)
    with closing(open_writer(tmp_path)) as writer:
        rows = random_samples(2000, 4, half_m=200.0)
        quarters = [rows[2 * (rows["x_m"] < 0) + (rows["y_m"] < 0) == i] for i in range(4)]
        send(writer, [incoming(quarter, machine=f"m-{i}") for i, quarter in enumerate(quarters)])  # each has its credit
        answers = answers_of(writer)
        for as_of_ns in (None, NOW_NS + 1800 * 10**9):
            pieces = [answers.tiles(TilesQuery(as_of_ns=as_of_ns))]
            while (place := pieces[-1].next_place) is not None:
                pieces.append(answers.tiles(TilesQuery(as_of_ns=as_of_ns, place=place)))
            assert len(pieces) > 3
            assert all(
                sum(len(tile.planes) for tile in piece.tiles) <= 3000 or len(piece.tiles) == 1 for piece in pieces
            )
            monkeypatch.setattr("mapserver.query.map_tiles.PIECE_BYTES", 10**9)
            whole = answers.tiles(TilesQuery(as_of_ns=as_of_ns))
            assert whole.next_place is None
            assert [tile for piece in pieces for tile in piece.tiles] == list(whole.tiles)
            monkeypatch.setattr("mapserver.query.map_tiles.PIECE_BYTES", 3000)


def test_evidence_that_no_plane_shows_makes_another_tile_too(tmp_path):
    """Watchers of the map read finer values where a tile has changed."""
    base = random_samples(3000, seed=0)
    with closing(open_writer(tmp_path)) as writer:
        send(writer, [incoming(base)])
        answers = answers_of(writer)
        version = answers.tiles(TilesQuery()).version
        for number in range(20):
            row = base[number : number + 1].copy()
            row["distance_m"] = 0.3
            send(writer, [incoming(row, spool_id=100 + number)])
            answer = answers.tiles(TilesQuery(version))
            assert answer.tiles, number
            version = answer.version
