"""The map over HTTP: the client's numbers, and clear refusals; real processes."""

from __future__ import annotations

import io
import json
import math
import signal
import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection
from websockets.sync.client import connect as open_socket

from protocol.queries.lanes import LanesQuery, strokes
from protocol.queries.map_tiles import TilesQuery
from protocol.queries.requests import CalibrationQuery, HistoryQuery, PointsQuery, WhyQuery
from protocol.site.site_config import Projection
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import encode_pose
from protocol.wire.messages import Pose
from protocol.wire.session import free_endpoint
from sitegrid.security.key_folder import issue, make_authority
from sitegrid.web import values
from tests.integration.forks import Forks
from tests.integration.site_run import kill
from tests.integration.web_site import NAME, Frame, WebSite
from tests.patience import PATIENCE_S, until
from tests.soak import SITE_TOML

pytestmark = pytest.mark.processes


def driven_place(web: WebSite) -> tuple[float, float]:
    region = web.client.region((0, 0, 300, 300), ["resistance"])
    rows, columns = np.nonzero(~np.isnan(region["resistance"]))
    return float(region.x_m[columns[7]]), float(region.y_m[rows[7]])


def same(ours: object, theirs: float) -> bool:
    return ours is None if math.isnan(theirs) else ours == pytest.approx(theirs, rel=1e-6)


def test_a_point_has_the_clients_numbers(web: WebSite):
    x_m, y_m = driven_place(web)
    point = web.client.point(x_m, y_m)
    assert set(web.client.point(x_m, y_m, "resistance").values) == {"resistance"}
    assert set(web.client.ask(PointsQuery(((x_m, y_m),), ("visits", "grade"))).layers) == {"visits", "grade"}
    answer = web.get("point", {"x": x_m, "y": y_m})
    assert answer.status == 200
    assert set(answer.json["values"]) == set(point.values)
    assert all(same(answer.json["values"][name], value) for name, value in point.values.items())
    assert (answer.json["store"], answer.json["merged"]) == (point.version.store, point.version.row)
    lat, lon = answer.json["lat_deg"], answer.json["lon_deg"]
    assert web.get("point", {"lat": lat, "lon": lon}).json["values"] == answer.json["values"]
    site = load_site(web.folder / "site.toml")
    assert Projection(site).to_map(lat, lon, 0)[:2] == pytest.approx((x_m, y_m), abs=1e-6)


def test_a_region_is_the_clients_as_text_and_as_arrays(web: WebSite):
    region = web.client.region((100, 100, 160, 150), ["resistance", "visits"])
    parameters = {"bounds": "100,100,160,150", "layers": "resistance,visits"}
    text = web.get("region", parameters).json
    arrays = np.load(io.BytesIO(web.get("region", {**parameters, "format": "npz"}).body))
    for name in ("resistance", "visits"):
        assert np.array_equal(np.array(text["layers"][name], np.float32), region[name], equal_nan=True)
        assert np.array_equal(arrays[name], region[name], equal_nan=True)
    assert text["x_m"] == region.x_m.tolist()
    inside = web.get("region", {"polygon": "100,100;160,100;100,150", "layers": "visits"}).json
    kept = np.array(inside["layers"]["visits"], np.float32)
    assert np.isnan(kept[-1, -1])
    assert np.array_equal(kept[0, :50], region["visits"][0, :50], equal_nan=True)


def test_larger_cells_and_outlines_are_the_clients(web: WebSite):
    outline = ((100.0, 100.0), (160.0, 100.0), (130.0, 150.0))
    region = web.client.region(outline, ["resistance"], resolution_m=5.0)
    asked = {"polygon": "100,100;160,100;130,150", "resolution": 5, "layers": "resistance"}
    answer = web.get("region", asked).json
    assert (answer["cell_m"], answer["x_m"]) == (5.0, region.x_m.tolist())
    assert np.array_equal(np.array(answer["layers"]["resistance"], np.float32), region["resistance"], equal_nan=True)
    # too much text in map cells is little in coarse ones
    wide = {"bounds": "0,0,900,900", "layers": "visits"}
    refused = web.get("region", wide)
    assert (refused.status, refused.json["reason"]) == (413, "too_large")
    assert "resolution" in refused.json["detail"]
    assert len(web.get("region", {**wide, "resolution": 10}).json["x_m"]) == 90


def test_why_history_machines_changes_are_the_clients(web: WebSite):
    x_m, y_m = driven_place(web)
    why, answer = web.client.ask(WhyQuery(x_m, y_m)), web.get("why", {"x": x_m, "y": y_m}).json
    assert answer["resistance"]["votes"] == pytest.approx(list(why.resistance.votes))
    assert answer["machines"] == list(why.machines)
    assert answer["newest_time"].startswith("2026-01-01T00:0")
    spans = web.get("history", {"x": x_m, "y": y_m, "layers": "resistance"}).json["spans"]
    ours = web.client.ask(HistoryQuery(x_m, y_m, ("resistance",))).spans
    assert [span["first_ns"] for span in spans] == [span.first_ns for span in ours]
    assert [m["name"] for m in web.get("machines").json["machines"]] == ["machine-0", "machine-1", "machine-2"]
    calibration, ours = web.get("calibration").json, web.client.ask(CalibrationQuery())
    assert (calibration["store"], calibration["fact"]) == (ours.store, ours.fact)
    assert [m["name"] for m in calibration["machines"]] == [m.name for m in ours.machines]
    assert calibration["machines"][0]["spans"] == [values.plain(span) for span in ours.machines[0].spans]
    assert web.get("changes").json == {"changes": []}
    info = web.get("info").json
    assert info["samples_merged"] == web.client.info().samples_merged
    assert web.get("/api/v1/sites").json["sites"][0]["name"] == NAME


def test_the_past_is_asked_for_by_time_or_stamp(web: WebSite):
    x_m, y_m = driven_place(web)
    by_stamp = web.get("point", {"x": x_m, "y": y_m, "as_of": 1_767_225_620_000_000_000}).json
    by_time = web.get("point", {"x": x_m, "y": y_m, "as_of": "2026-01-01T00:00:20Z"}).json
    by_zone = web.get("point", {"x": x_m, "y": y_m, "as_of": "2026-01-01T01:00:20+01:00"}).json
    assert by_stamp["values"] == by_time["values"] == by_zone["values"]
    assert by_stamp["stamp_ns"] == 1_767_225_620_000_000_000
    point = web.client.point(x_m, y_m, as_of=1_767_225_620_000_000_000)
    assert all(same(by_time["values"][name], value) for name, value in point.values.items())
    frame = Frame.read(web.get("tiles", {"as_of": "2026-01-01T00:00:20Z"}).body)
    assert frame.head["whole"]
    assert {(tile.x, tile.y): (tile.newest_ns, tile_planes(tile)) for tile in web.client.ask(TilesQuery(
        as_of_ns=1_767_225_620_000_000_000
    )).tiles} == frame.tiles  # fmt: skip


def test_lanes_are_those_that_agents_get_as_columns(web: WebSite):
    table, columns = web.get("lanes").json, strokes(web.client.ask(LanesQuery()))
    assert len(table["metres"]) > 50
    for name, column in columns.items():
        np.testing.assert_allclose(table[name], column, rtol=1e-6)


def tile_planes(tile) -> bytes:
    import zlib

    return zlib.decompress(tile.planes)


@pytest.mark.parametrize(
    ("path", "parameters", "status", "reason"),
    [
        ("point", {"x": "nan", "y": 1}, 400, "not_finite"),
        ("point", {"lat": 91, "lon": 8}, 400, "out_of_range"),
        ("point", {"x": 1, "y": 1, "colour": "red"}, 400, "unknown_parameter"),
        ("region", {"bounds": "0,0,9000,9000"}, 413, "too_large"),
        ("region", {"polygon": "0,0;9,0;0,9", "bounds": "0,0,9,9"}, 400, "out_of_range"),
        ("region", {"bounds": "0,0,9,9", "resolution": 5, "layers": "heading"}, 400, "out_of_range"),
        ("region", {"bounds": "0,0,9,9", "repairs": 1}, 400, "unknown_parameter"),
        ("point", {"x": 1, "y": 1, "minus": "yesterday"}, 400, "wrong_type"),
        ("tiles", {"store": "x", "row": -1, "fact": 0}, 400, "out_of_range"),
        ("nothing", {}, 404, "not_found"),
        ("/api/v1/sites/elsewhere/info", {}, 404, "unknown_site"),
        ("xyz/colour/resistance/30/0/0.png", {}, 400, "out_of_range"),
        ("xyz/colour/mud/3/0/0.png", {}, 404, "unknown_layer"),
        ("xyz/red/resistance/3/0/0.png", {}, 400, "out_of_range"),
        ("/../../etc/passwd", {}, 404, "not_found"),
    ],
)
def test_bad_input_is_one_clear_problem(web: WebSite, path, parameters, status, reason):
    answer = web.get(path, parameters)
    assert (answer.status, answer.json["reason"]) == (status, reason)
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json["detail"]
    assert "\n" not in answer.json["detail"]
    assert web.get("info").status == 200


def test_what_is_no_question_is_refused(web: WebSite):
    assert web.request("POST", f"/api/v1/sites/{NAME}/info").status == 405
    assert web.request("POST", f"/api/v1/sites/{NAME}/info", body=b"{" * 100).status == 413
    assert web.get("/" + "a" * 40_000).status == 414
    assert web.get("info", Origin="https://elsewhere.example").status == 403
    assert web.get("info", Origin=web.url.rstrip("/")).status == 200
    for word in ("refused_wrong_origin", "refused_too_large"):
        assert f'sitegrid_web_total{{event="{word}"}}' in web.get("/metrics").body.decode()
    assert web.get("/healthz").body == b"ok\n"


CHUNKED, SECOND = "Transfer-Encoding: chunked", "0\r\n\r\nGET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
LOST = f"/api/v1/sites/{NAME}/xyz/value/visits/{'9' * 4400}/0/0.png"  # an absurd number
RAW = [  # request, headers -> status of its only answer before the end
    ("POST / localhost", ["Content-Length: 6", CHUNKED], 400),  # SECOND is in or after its body
    ("GET / localhost", [CHUNKED, "Content-Length: 0"], 400),
    ("POST / localhost", ["Content-Length: 5", "Content-Length: 6"], 400),
    ("POST / localhost", ["Content-Length: 5, 5"], 413),
    ("GET /healthz evil.example", ["Connection: close"], 200),
    ("GET /api/v1/sites evil.example", ["Connection: close"], 421),
    ("GET / 10.0.0.1.evil.example", ["Connection: close"], 421),
    ("GET / evil@localhost", ["Connection: close"], 421),
    ("GET / [::1", ["Connection: close"], 421),
    ("GET /api/v1/sites Map.Example:8080", ["Connection: close"], 200),
    ("GET /api/v1/sites localhost:1", ["Connection: close"], 200),
    ("GET /api/v1/sites [fe80::1]:80", ["Connection: close"], 200),
    ("GET / localhost", ["Origin: http://[", "Connection: close"], 403),
    (f"GET {LOST} localhost", ["Connection: close"], 414),
]
FRAMES = {  # WebSocket frames, masked with zeros -> close code
    "bytes": (b"\x82\x81\0\0\0\0x", 1007),
    "no UTF-8": (b"\x81\x82\0\0\0\0\xff\xfe", 1007),
    "infinite": (b'\x81\x96\0\0\0\0{"row":1e999,"fact":1}', 1007),
    "no table": (b"\x81\x84\0\0\0\0null", 1007),
    "reserved": (b"\xc1\x81\0\0\0\0x", 1002),
    "unmasked": (b"\x81\x01x", 1002),
    "goes on with nothing": (b"\x80\x81\0\0\0\0x", 1002),
}


@pytest.mark.parametrize(("line", "headers", "status"), RAW)
def test_a_request_that_lies_gets_one_answer_and_an_end(web: WebSite, line: str, headers: list[str], status: int):
    method, path, host = line.split()
    request = "\r\n".join([f"{method} {path} HTTP/1.1", f"Host: {host}", *headers, "", SECOND])
    with socket.create_connection(("127.0.0.1", web.port), PATIENCE_S) as visitor:
        visitor.sendall(request.encode())
        answer = b"".join(iter(lambda: visitor.recv(65536), b""))
    assert (answer[:13], answer.count(b"HTTP/1.1 ")) == (f"HTTP/1.1 {status} ".encode(), 1)
    assert (b"start it with --host" in answer) == (status == 421)
    assert "Traceback" not in (web.folder / "web.log").read_text()


@pytest.mark.parametrize("name", FRAMES)
def test_a_frame_that_is_none_closes_its_connection_without_a_traceback(web: WebSite, name: str):
    frame, code = FRAMES[name]
    with open_socket(web.live_url(), compression=None, max_size=2**26) as page:
        page.socket.sendall(frame)
        with pytest.raises(ConnectionClosed) as ended:
            _drain(page)
    assert ended.value.rcvd.code == code
    assert "Traceback" not in (web.folder / "web.log").read_text()


def test_the_page_has_strict_headers_and_asks_nobody_else(web: WebSite):
    answer = web.get("/")
    assert answer.status == 200
    assert "script-src 'self'" in answer.headers["content-security-policy"]
    for name in ("main.js", "style.css", "icon.svg"):
        text = web.get(f"/{name}").body.decode()
        assert "http://" not in text.replace("http://www.w3.org/2000/svg", "")
        assert "https://" not in text


def test_a_copy_is_confirmed_until_the_map_is_another_one(web: WebSite):
    x_m, y_m = driven_place(web)
    parameters = {"x": x_m, "y": y_m, "layers": "resistance"}
    first = web.get("point", parameters)
    tag = first.headers["etag"]
    for known in (tag, f"W/{tag}", f'"other", W/{tag} ,"more"', "*"):  # as from caches and proxies
        again = web.get("point", parameters, If_None_Match=known)
        assert (again.status, again.body) == (304, b""), known
    for other in ('"*"', f'{tag[:-1]}0"', "W/*", ""):
        assert web.get("point", parameters, If_None_Match=other).status == 200, other
    web.drive(4)
    until(lambda: web.get("point", parameters, If_None_Match=first.headers["etag"]).status == 200, "another map")


def test_a_pose_under_the_key_of_another_machine_is_counted_and_not_shown(web: WebSite):
    def shown() -> list[object]:
        for machine, x_m in (("machine-0", 5.0), ("machine-1", 1.0), ("machine-0", 1e308)):  # all by machine-0
            pose = Pose(machine, web.now_ns, x_m, *[0.0] * 6)
            web.session.put(keys.pose(NAME, "machine-0"), encode_pose(pose))
        places = web.get("features/machines").json["features"]
        return [place["properties"]["machine"] for place in places]

    until(lambda: shown() == ["machine-0"], "a pose")
    for reason in ("wrong_machine", "out_of_range"):
        counted = f'sitegrid_web_poses_refused_total{{site="{NAME}",reason="{reason}"}}'
        until(lambda counted=counted: counted in web.get("/metrics").body.decode(), counted)
    assert shown() == ["machine-0"]


@pytest.mark.nightly
def test_slow_headers_and_handshakes_do_not_hold_a_place(web: WebSite, tmp_path: Path):
    now = datetime.now(UTC)
    pair = issue(make_authority(NAME, now, now + timedelta(1)), "web", now, now + timedelta(1), ("127.0.0.1",))
    (tmp_path / "cert.pem").write_bytes(pair.certificate)
    (tmp_path / "key.pem").write_bytes(pair.key)
    words = ("--endpoint", web.endpoint, "--listen", "0", "--site", NAME, "--tls", tmp_path)
    url = web.children.start("tls", "web", *words).expect("ready", PATIENCE_S)["url"]
    with (
        socket.create_connection(("127.0.0.1", web.port), 30) as slow,
        socket.create_connection(("127.0.0.1", urlsplit(url).port), 30) as silent,
    ):
        slow.sendall(b"GET / HTTP/1.1\r\nHost: x\r\nX-Slow: ")
        assert slow.recv(1000) == silent.recv(1000) == b""


def test_it_waits_for_a_router(tmp_path: Path):
    with Forks(tmp_path) as children:
        endpoint = free_endpoint()
        web = children.start("web", "web", "--endpoint", endpoint, "--listen", "0")
        until(lambda: "waiting for the router" in (tmp_path / "web.log").read_text(), "that it says so")
        children.start("router", "router", "--listen", endpoint).expect("ready", PATIENCE_S)
        web.expect("ready", PATIENCE_S)


@pytest.mark.nightly
def test_two_sites_stand_behind_one_address(tmp_path: Path):
    with Forks(tmp_path) as children:
        web = WebSite(tmp_path, children, "--site", "pit")
        (tmp_path / "pit.toml").write_text(SITE_TOML.replace('"soak"', '"pit"'))
        words = ("--site-file", tmp_path / "pit.toml", "--store", tmp_path / "pit")
        children.start("pit", "server", "--endpoint", web.endpoint, *words).expect("ready", PATIENCE_S)
        web.drive(4)
        assert [site["name"] for site in web.get("/api/v1/sites").json["sites"]] == [NAME, "pit"]
        assert web.get("info").json["samples_merged"] > 0
        assert web.get("/api/v1/sites/pit/info").json["samples_merged"] == 0


# --- the live connection ---------------------------------------------------------------------------------------------


class Page:
    """A page without browser; tiles must never go back."""

    def __init__(self, web: WebSite) -> None:
        self.web, self.socket = web, None
        self.tiles: dict[tuple[int, int], tuple[int, bytes]] = {}
        self.versions: dict[tuple[int, int], tuple[int, int]] = {}
        self.store, self.version, self.frames = "", (0, 0), 0

    def open(self) -> ClientConnection:
        known = {"store": self.store, "row": self.version[0], "fact": self.version[1]} if self.store else {}
        self.socket = open_socket(self.web.live_url(**known), max_size=2**26, compression=None)
        return self.socket

    def take(self, until: tuple[int, int]) -> None:
        """Receive up to this map version."""
        while self.version < until or not self.frames:
            data = self.socket.recv(timeout=PATIENCE_S)
            if isinstance(data, bytes):
                self.take_in(Frame.read(data))
                self.socket.send(json.dumps({"row": self.version[0], "fact": self.version[1]}))

    def take_in(self, frame: Frame) -> None:
        if frame.head["whole"]:
            self.tiles.clear()
        same_store = frame.head["store"] == self.store
        for tile in frame.head["tiles"]:
            place, version = (tile["x"], tile["y"]), (tile["row"], tile["fact"])
            if same_store:
                assert version >= self.versions.get(place, (0, 0)), "a tile went back"
            self.versions[place] = version
        assert not same_store or frame.version >= self.version, "the map went back"
        self.tiles |= frame.tiles
        self.store, self.version, self.frames = frame.head["store"], frame.version, self.frames + 1


def newest(web: WebSite) -> tuple[dict[tuple[int, int], tuple[int, bytes]], tuple[int, int]]:
    """A fresh snapshot, its version."""
    frame = Frame.read(web.get("tiles").body)
    return frame.tiles, frame.version


def test_pages_that_are_fast_slow_or_asleep_end_with_the_map_as_it_is(web: WebSite):
    fast, slow = Page(web), Page(web)
    with fast.open(), slow.open():
        fast.take((1, 0))
        slow.take((1, 0))
        for _ in range(4):
            web.drive(4)
            fast.take((web.client.info().merged - 2, 0))
        frames_of_fast = fast.frames
        tiles, version = newest(web)
        last = max((tile.row for tile in web.client.ask(TilesQuery()).tiles), default=0)
        fast.take((last, 0))
        slow.take((last, 0))  # asleep for four drives, received as one or two maps
        assert fast.tiles == slow.tiles == tiles
        assert slow.frames < frames_of_fast
        assert version >= (last, 0)


@pytest.mark.nightly
def test_a_page_goes_on_after_web_server_map_server_and_trust_were_others(tmp_path: Path):
    with Forks(tmp_path) as children:
        web = WebSite(tmp_path, children)
        web.drive(24)
        page = Page(web)
        with page.open():
            page.take((1, 0))
        port = web.port
        kill(web.web)
        web.drive(8)
        web.web = web.start_web(port=port)
        with page.open():
            page.take((max(tile.row for tile in web.client.ask(TilesQuery()).tiles), 0))
            assert page.tiles == newest(web)[0]
            web.server.send(signal.SIGKILL)
            web.server.wait(PATIENCE_S)
            web.server = web.start_server()
            web.drive(8)
            page.take((max(tile.row for tile in web.client.ask(TilesQuery()).tiles), 0))
            assert page.tiles == newest(web)[0]
            trusted = web.client.distrust("machine-1", "test")
            page.take((trusted.merged, trusted.fact))
            assert page.tiles == newest(web)[0]
            assert page.version >= (trusted.merged, trusted.fact)


def test_what_a_page_says_wrongly_ends_its_connection_alone(web: WebSite):
    with open_socket(web.live_url(), compression=None) as wrong:
        wrong.send("[" * 2000)
        with pytest.raises(ConnectionClosed):
            _drain(wrong)
    page = Page(web)
    with page.open():
        page.take((1, 0))
    assert web.get("info").status == 200


def _drain(socket: ClientConnection) -> None:
    for _ in range(1000):
        socket.recv(timeout=PATIENCE_S)
