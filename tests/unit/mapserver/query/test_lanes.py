"""Lanes equal the fold by heading; abandoned ones fade."""

import zlib
from contextlib import closing
from dataclasses import replace

import msgpack
import numpy as np
import pytest

from mapserver.config import ServerConfig
from mapserver.evidence import cells as ev
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.layers.cell_layers import LAYERS
from mapserver.query.views import read_cells, read_lanes, view_of
from protocol.errors import MessageError
from protocol.machine.samples import empty
from protocol.queries.lanes import SCALE_M, SLOPE_STEP, UNKNOWN_SLOPE, LanesQuery, decode_lanes, encode_lanes, strokes
from protocol.queries.requests import parse_query
from protocol.site.geometry import Bounds, CellWindow
from tests.unit.mapserver.data import SITE, incoming, open_writer, random_samples, send
from tests.unit.mapserver.query.fake_upkeep import answers_of

DAY_NS = 86_400 * 10**9
NORTH = 4  # sector
BEGIN_NS = 1_750_000_000 * 10**9 // DAY_NS * DAY_NS


def passes(x_m, count, begin_ns):
    """Northward passes on a line, one a minute."""
    y_m = np.tile(np.arange(0.0, 64.0, 0.5), count)
    rows = empty(len(y_m))
    rows["stamp_ns"] = begin_ns + np.repeat(np.arange(count), 128) * 60 * 10**9 + np.tile(np.arange(128), count) * 10**8
    rows["x_m"], rows["y_m"], rows["heading_rad"], rows["distance_m"] = x_m, y_m, np.pi / 2, 0.5
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.1
    rows["c_rr"], rows["c_rr_var"], rows["grade_var"] = 0.03, 1e-4, 1e-4
    return rows


def lanes_of(*tables):
    grid = Grid(1.0, FoldConfig())
    for number, rows in enumerate(tables):
        grid.fold(rows, f"loader-{number}")
    view = view_of(grid, CellWindow(-64, -64, 192, 192), ServerConfig())
    return read_lanes(view, None, None, 1.0, ServerConfig())


def metres(answer, x, y, column):
    (tile,) = (tile for tile in answer.tiles if (tile.x, tile.y) == (x, y))
    values = np.nan_to_num(SCALE_M.values())[tile.metres].reshape(ev.SECTORS, 16, 16)
    return values[NORTH, :, column].mean()


def test_lanes_are_the_metres_driven_by_heading():
    answer = lanes_of(passes(8.5, 3, BEGIN_NS))
    inner = [tile for tile in answer.tiles if tile.x == 0 and 0 <= tile.y < 4]
    assert [(tile.passes, tile.days, tile.machines) for tile in inner] == [(3, 1, 1)] * 4
    assert metres(answer, 0, 1, 8) == pytest.approx(metres(answer, 0, 2, 8), rel=0.05)
    for tile in inner:
        assert not np.delete(tile.metres, NORTH, axis=0).any()


def test_a_lane_fades_as_machines_drive_beside_it_and_with_its_age():
    old, new = passes(4.5, 6, BEGIN_NS), passes(10.5, 24, BEGIN_NS + DAY_NS)
    answer = lanes_of(old, new)
    assert metres(answer, 0, 1, 4) < 0.1 * metres(lanes_of(old), 0, 1, 4)
    far = passes(80.5, 1, BEGIN_NS + 7 * DAY_NS)  # the site's now is a week later
    assert metres(lanes_of(old, far), 0, 1, 4) == pytest.approx(0.5 * metres(lanes_of(old), 0, 1, 4), rel=0.05)


def test_lanes_weigh_passes_by_what_is_left_of_them_and_no_other_layer_does():
    own, aided = passes(8.5, 3, BEGIN_NS), passes(8.5, 3, BEGIN_NS)
    aided["aid_share"] = np.repeat([0.0, 0.75, 1.0], 128)
    alone = metres(lanes_of(passes(8.5, 1, BEGIN_NS)), 0, 1, 8)
    assert metres(lanes_of(own), 0, 1, 8) == pytest.approx(3 * alone, rel=0.03)
    assert metres(lanes_of(aided), 0, 1, 8) == pytest.approx(1.25 * alone, rel=0.03)
    window, grids = CellWindow(0, 0, 32, 64), []
    for rows in (own, aided):
        grids.append(Grid(1.0, FoldConfig()))
        grids[-1].fold(rows, "loader")
    views = (view_of(grid, window, ServerConfig()) for grid in grids)
    plain, marked = (read_cells(view, window, tuple(LAYERS), 1.0, ServerConfig()) for view in views)
    for name in LAYERS:
        np.testing.assert_array_equal(plain[name], marked[name], name)


def test_lanes_are_asked_for_whole_by_place_and_by_news(tmp_path):
    rows = random_samples(2000, seed=3)
    later = replace_stamps(passes(8.5, 2, 0), int(rows["stamp_ns"].max()) + 1)
    with closing(open_writer(tmp_path / "store")) as writer:
        send(writer, [incoming(rows, machine="a"), incoming(later, machine="b")])
        answers = answers_of(writer)

        def ask(query):
            sent = parse_query("lanes", query.parameters())
            assert sent == query
            return query.decode(answers.answer(sent))

        whole = ask(LanesQuery())
        west = ask(LanesQuery(Bounds(-100.0, -100.0, 0.0, 100.0)))
        news = ask(LanesQuery(since_ns=int(rows["stamp_ns"].max())))
    assert {(tile.x, tile.y) for tile in west.tiles} == {(t.x, t.y) for t in whole.tiles if t.x < 0}
    assert 0 < len(news.tiles) < len(whole.tiles)
    assert {tile.x for tile in news.tiles} <= {-1, 0, 1}
    assert whole.cell_m == SITE.cell_m


def slopes(answer, x, y):
    """East and north of 4 x 4 parts of a square."""
    (tile,) = (tile for tile in answer.tiles if (tile.x, tile.y) == (x, y))
    steps = tile.slopes.reshape(2, 4, 4).astype(float)
    return np.where(steps == UNKNOWN_SLOPE, np.nan, SLOPE_STEP * steps)


def sloped(rows, east, north):
    rows["grade_e"], rows["grade_n"] = east, north
    return rows


def test_slopes_are_the_gradient_where_machines_drove_and_nan_elsewhere():
    first = passes(5.5, 3, BEGIN_NS)
    east, north = slopes(lanes_of(sloped(first, 0.013, -0.4 + 0.01 * np.floor(first["y_m"] / 4))), 0, 1)
    np.testing.assert_allclose(east[:, 1], 0.013, atol=SLOPE_STEP)
    np.testing.assert_allclose(north[:, 1], -0.254)  # steeper is not told apart
    assert np.isnan(east[:, 3]).all()
    assert np.isnan(north[:, 3]).all()
    assert np.isnan(slopes(lanes_of(sloped(first.copy(), np.nan, np.nan)), 0, 1)).all()  # of machines without an IMU
    north = slopes(lanes_of(sloped(first, 0.0, 0.01 * np.floor(first["y_m"] / 4))), 0, 1)[1]
    np.testing.assert_allclose(north[:, 1], 0.01 * np.arange(4, 8), atol=2 * SLOPE_STEP)


def test_slopes_follow_ground_that_was_shaped_anew_and_leave_out_what_lanes_placed():
    old, new = (sloped(passes(5.5, 6, BEGIN_NS + i * DAY_NS), slope, 0.0) for i, slope in enumerate((0.0, 0.03)))
    aided = new.copy()
    aided["aid_share"] = 1.0
    kept = 0.9 * np.exp(-6 * 16 / 128)  # of the old passes: a day, six passes of a square
    np.testing.assert_allclose(slopes(lanes_of(old, new), 0, 1)[0, :, 1], 0.03 / (1 + kept), atol=SLOPE_STEP)
    np.testing.assert_allclose(slopes(lanes_of(old, aided), 0, 1)[0, :, 1], 0.0, atol=1e-9)


def test_lanes_of_a_server_without_slopes_have_none():
    answer = lanes_of(sloped(passes(5.5, 3, BEGIN_NS), 0.01, 0.0))
    table = msgpack.unpackb(encode_lanes(replace(answer, version=replace(answer.version, store="0123456789abcdef"))))
    slopes_of = table.pop("slopes")
    assert all((tile.slopes == UNKNOWN_SLOPE).all() for tile in decode_lanes(msgpack.packb(table)).tiles)
    for bad, reason in ((zlib.compress(b"x"), "column_length"), (b"xyz", "wrong_type"), ([1], "wrong_type")):
        with pytest.raises(MessageError, match="slopes") as refused:
            decode_lanes(msgpack.packb({**table, "slopes": bad}))
        assert refused.value.reason == reason
        assert "\n" not in str(refused.value)
    assert len(slopes_of) < 0.25 * len(table["metres"])


def test_strokes_lie_where_machines_drove_and_the_way_they_did():
    columns = strokes(lanes_of(passes(8.5, 3, BEGIN_NS)))
    strong = columns["metres"] > 1
    assert columns["y_m"][strong].min() < 1 < 63 < columns["y_m"][strong].max()
    assert np.abs(columns["x_m"][strong] - 8.5).max() <= 1
    assert columns["heading_rad"] == pytest.approx(np.pi / 2)
    assert all(len(values) == 0 for values in strokes(replace(lanes_of(), tiles=())).values())


def replace_stamps(rows, first_ns):
    rows["stamp_ns"] += first_ns - rows["stamp_ns"][0]
    return rows


def test_damaged_lanes_are_refused_by_name():
    answer = lanes_of(passes(8.5, 1, BEGIN_NS))
    data = encode_lanes(replace(answer, version=replace(answer.version, store="0123456789abcdef")))
    assert len(decode_lanes(data).tiles) == len(answer.tiles)
    refused = 0
    for at in range(0, len(data), 7):
        try:
            decode_lanes(data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :])
        except MessageError as error:
            refused += bool(error.reason)
    assert refused > len(data) / 7 / 3
