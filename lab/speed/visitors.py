"""Memory that a visitor's worst questions cost the map server and the web server.

Each question asks, over HTTP, or over Zenoh where that allows more, what its limits allow of a square of known ground.
Figures are peaks over memory before it: of one question, then of some at once, none taken in before all are being
answered. The last row is what stays after all questions: what visitors share.
"""

from __future__ import annotations

import select
import socket
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from lab.speed.measure import Figures, rows_of
from lab.speed.site import SITE, Site, forget_peak_mb, settle
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Admission
from protocol.arrays import Table
from protocol.errors import QueryError
from protocol.machine.samples import empty
from protocol.queries.parameters import split_selector
from protocol.queries.requests import parse_query
from protocol.units import HOUR_NS
from protocol.wire.messages import SampleBatch
from sitegrid.client import connect
from sitegrid.proof.figures import Row
from sitegrid.web.xyz.mercator import tiles_at
from tests.memory import memory_mb
from tests.site_work import START_NS

OPTIONS = {"queries": 20}
MOST_MB = 300.0  # of one question, and of all at once
KNOWN_M, LANE_M, STEP_M, STD_M = 1888.0, 16.0, 2.0, 2.5  # 13,924 blocks, 195 MB: a past time may read 201
SPEED_MPS = 10.0
WAIT_S = 600.0  # for an answer
MANY = 10_000  # places of a line or list over Zenoh
FEW = 1500  # over HTTP
PATH = f"/api/v1/sites/{SITE.name}/"


def _places(count: int, between: str) -> str:
    places = np.random.default_rng(0).uniform(0.0, KNOWN_M, (count, 2)).round().astype(int).tolist()
    return between.join(f"{x},{y}" for x, y in places)


def _zigzag(count: int) -> str:
    """Places of a line all over the ground, at most 100 km."""
    lanes = 48
    each = count // lanes
    y = np.linspace(0.0, KNOWN_M - 1, each).round(1)
    x = np.linspace(5.0, KNOWN_M - 5, lanes).round(1)
    places = [(a, b) for i, a in enumerate(x.tolist()) for b in (y if i % 2 else y[::-1]).tolist()]
    return ",".join(f"{a:g},{b:g}" for a, b in places)


def _xyz(zoom: int) -> str:
    """Column and row of the tile at the ground's middle."""
    middle = np.array([[SITE.origin_lat_deg + 0.009], [SITE.origin_lon_deg + 0.013]])
    column, row = tiles_at(middle[0], middle[1], zoom)
    return f"{int(column[0])}/{int(row[0])}"


def questions() -> dict[str, str]:
    """The worst question of each kind: a path of the web server, or `zenoh NAME` and a selector."""
    whole = f"bounds=0,0,{KNOWN_M:g},{KNOWN_M:g}"
    past = START_NS + HOUR_NS
    times = f"as_of={past}&minus={START_NS + HOUR_NS // 2}"
    way = "from=700,700&to=1060,1060"  # searched in 989 x 989 cells, of 1,000,000
    wide = f"bounds=0,0,{KNOWN_M - 1:g},{KNOWN_M - 1:g}&layers=resistance,grade,visits"
    asked = {
        "region json": f"region?bounds=0,0,499,499&{wide.partition('&')[2]}",
        "region npz": f"region?{wide}&format=npz",
        "region all layers": "region?bounds=0,0,790,790&format=npz",
        "region coarse": f"region?{whole}&resolution=64&layers=resistance,grade,visits",
        "region past": f"region?{wide}&{times}&format=npz",
        "points": f"points?places={_places(FEW, ';')}",
        "points past": f"points?places={_places(FEW, ';')}&{times}",
        "history": "history?x=16&y=900&span=1",
        "why": "why?x=16&y=900",
        "tiles": "tiles",
        "tiles past": f"tiles?as_of={past}",
        "lanes": "lanes",
        "coverage": "coverage",
        "coverage past": f"coverage?as_of={past}",
        "segments": "segments",
        "segments past": f"segments?as_of={past}",
        "worklist": "worklist?limit=1000",
        "features/segments": "features/segments",
        "features/zones": "features/zones",
        "features/zones fgb": "features/zones?format=fgb",
        "route": f"route?line={_zigzag(FEW)}&step=20",
        "way": f"way?{way}",
        "xyz coarse": f"xyz/value/resistance/15/{_xyz(15)}.png",
        "xyz fine": f"xyz/value/resistance/18/{_xyz(18)}.png",
    }
    direct = {
        "zenoh region": f"region?bounds=-1000,-1000,{2999 - 1},{2999 - 1}",
        "zenoh points": f"points?places={_places(MANY, ',')}",
        "zenoh route": f"route?line={_zigzag(MANY)};step=20",
    }
    return {name: PATH + path for name, path in asked.items()} | direct


GOALS = {
    (name, f"{role}_{many}_mb"): f"<= {MOST_MB:g}"
    for name in questions()
    for role in ("server", "web")
    for many in ("one", "many")
}


def run(queries: int) -> Iterator[Row]:
    """Each question alone, then `queries` at once."""
    with tempfile.TemporaryDirectory() as path, Site(Path(path)) as site:
        _write_ground(Path(path))
        with site.serving() as server, site.showing() as (web, url):
            settle(server)
            visited = Visited(site.endpoint, url, {"server": server, "web": web})
            for name, question in questions().items():
                yield from rows_of(name, visited.cost(question, queries))
            yield from rows_of("stays", visited.stays())


class Visited:
    """A map server and a web server at rest. pids: by role."""

    def __init__(self, endpoint: str, url: str, pids: Mapping[str, int]) -> None:
        self._endpoint, self._port, self._pids = endpoint, urlsplit(url).port or 80, pids
        self._rest_mb = self._used_mb()

    def _used_mb(self, kind: str = "VmRSS") -> dict[str, float]:
        return {role: memory_mb(kind, pid) for role, pid in self._pids.items()}

    def cost(self, question: str, count: int) -> Figures:
        """Peaks [MB] of one question and of `count` at once, and how many of these were answered."""
        figures: dict[str, float | None] = {}
        for many, n in (("one", 1), ("many", count)):
            for pid in self._pids.values():
                forget_peak_mb(pid)
            before_mb = self._used_mb()
            figures[f"answered_{many}"] = self._asked(question, n)
            figures |= {f"{role}_{many}_mb": mb - before_mb[role] for role, mb in self._used_mb("VmHWM").items()}
        return figures

    def stays(self) -> Figures:
        """Growth [MB] since rest."""
        return {f"{role}_mb": mb - self._rest_mb[role] for role, mb in self._used_mb().items()}

    def _asked(self, question: str, count: int) -> int:
        if question.startswith("/"):
            return _over_http(self._port, question, count)
        return _over_zenoh(self._endpoint, question, count)


def _over_zenoh(endpoint: str, question: str, count: int) -> int:
    """Ask `count` times at once; returns how many were answered, not refused."""
    name, _, parameters = question.partition("?")
    query = parse_query(name, split_selector(parameters))

    def ask(_: int) -> int:
        with suppress(QueryError), closing(connect(endpoint, SITE.name, timeout_s=WAIT_S)) as client:
            client.ask(query)
            return 1
        return 0

    with ThreadPoolExecutor(count) as threads:
        return sum(threads.map(ask, range(count)))


def _over_http(port: int, path: str, count: int) -> int:
    """Open all connections, and read once every one has its first byte."""
    opened = [socket.create_connection(("127.0.0.1", port), WAIT_S) for _ in range(count)]
    for connection in opened:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n".encode())
    waiting = set(opened)
    while waiting:
        ready, _, _ = select.select(waiting, [], [], WAIT_S)
        if not ready:
            raise RuntimeError(f"{path[:80]}: no answer within {WAIT_S:g} s")
        waiting -= set(ready)
    with ThreadPoolExecutor(count) as threads:
        return sum(threads.map(_is_taken, opened))


def _is_taken(connection: socket.socket) -> bool:
    """Take an answer in; whether it is a whole one. The server ends those that wait for the others too long."""
    with closing(connection), suppress(ConnectionError):
        head = connection.recv(12)
        while connection.recv(2**20):
            pass
        return head.endswith(b" 200")
    return False


# --- the ground ------------------------------------------------------------------------------------------------------


def _write_ground(folder: Path) -> None:
    """A journal of lanes to and fro over a square, in an hour."""
    journal, draw = JournalLocation(folder).open(SITE.name, SITE.frame), np.random.default_rng(0)
    lanes = np.arange(0.0, KNOWN_M, LANE_M).tolist()
    journal.begin()
    for lane, x_m in enumerate(lanes):
        rows = _lane(draw, x_m, START_NS + lane * HOUR_NS // len(lanes))
        batch = SampleBatch("surveyor", 1, 1 + lane * len(rows), rows, SITE.frame)
        journal.append(Admission(batch, trimmed=0, lost=0), START_NS)
    journal.commit()
    journal.close()


def _lane(draw: np.random.Generator, x_m: float, first_ns: int) -> Table:
    """Samples along a lane; values without pattern, so that nothing of them compresses."""
    along_m = np.arange(0.0, KNOWN_M, STEP_M)
    rows = empty(len(along_m))
    rows["stamp_ns"] = first_ns + np.arange(len(rows)) * round(STEP_M / SPEED_MPS * 1e8)
    rows["x_m"], rows["y_m"] = x_m, along_m
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = STD_M**2
    rows["heading_rad"] = np.pi / 2
    rows["distance_m"], rows["speed_mps"] = STEP_M, SPEED_MPS
    rows["c_rr"] = np.abs(draw.normal(0.05, 0.03, len(rows)))
    rows["c_rr_var"] = rows["grade_var"] = 1e-4
    rows["grade_e"], rows["grade_n"] = draw.normal(0.0, 0.05, (2, len(rows)))
    return rows
