"""The web server with pages open, tiles asked for and ten machines at work: what it costs, and how soon people see it.

It is one module because each figure is of the same site. Router, map server and web server are processes of their own.
Pages are plain WebSocket clients, which take in what they get as the live page does; one is the page itself, in
Chromium where there is one.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import math
import shutil
import struct
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import partial
from http import HTTPStatus
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as open_socket

from lab.speed.measure import Report, machine, memory_mb, timed
from lab.speed.merge_restart import SITE, build
from lab.speed.merge_work import BATCH, MACHINES, SPEED_MPS, Batches, batches, samples_of, seconds_of
from lab.speed.processes import at_work, process, processor_s, send, served, session, settle
from protocol.site.site_config import Projection
from protocol.wire import keys
from protocol.wire.codec import encode_pose
from protocol.wire.messages import Pose, SampleBatch
from protocol.wire.session import free_endpoint

GOALS = {
    "web server, five pages [% of a core]": 10.0,
    "map server, for five pages [ms/s]": 60.0,
    "change to paint, 95 % [ms]": 200.0,
    "slider, cached hour, 95 % [ms]": 100.0,
    "XYZ tile, fresh, 95 % [ms]": 60.0,
    "XYZ tile, cached, 95 % [ms]": 20.0,
    "pages behind the map, most [ms]": 1000.0,
    "memory, while 10 of 50 pages sleep [MB]": 20.0,
    "first paint [ms]": 1000.0,
    "first paint [kB]": 500.0,
}
PAGES, MANY, SLEEPERS = 5, 50, 10
POSES = 4  # of a machine in a second
ZOOM = 18
TILES = 60
HOUR_NS = 3600 * 10**9
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
NO_BROWSER = "install Chromium and Playwright: `apt-get install chromium`, `pip install playwright`"
# When a page has painted which row of the journal, by the clock that all processes share.
WATCH = """() => { window.seen = []; const look = () => { requestAnimationFrame(look);
  const row = sitegrid.map.row ?? 0, last = seen.at(-1)?.[1] ?? -1;
  if (row > last && !sitegrid.dirty) seen.push([performance.timeOrigin + performance.now(), row]); }; look(); }"""
PAINTED = """() => Boolean(window.sitegrid && [...sitegrid.map.tiles.values()].some((tile) => tile.painted))"""
QUIET: dict[str, Any] = {"compression": None, "max_queue": 1, "ping_interval": None, "close_timeout": 0.1}
Figures = Iterator[tuple[str, float]]


def run(hours: float, seconds: float) -> Report:
    """Open pages after so many hours of work, each time for so many seconds.

    Rows: what was measured, its value, its goal. Without a browser, what needs one is missing. Changes are painted at
    the earliest after the machine was acknowledged: that is when their time begins.
    """
    work = batches()
    before = samples_of(hours) // BATCH
    for _ in islice(work, before):
        pass
    with tempfile.TemporaryDirectory() as path, ExitStack() as opened:
        build(Path(path), before, tail_rows=0)
        endpoint, server = opened.enter_context(served(Path(path), SITE))
        port = int(free_endpoint().rpartition(":")[2])
        words = ("sitegrid.cli", "web", "--endpoint", endpoint, "--site", SITE.name, "--listen", str(port))
        site = _Site(port, server, opened.enter_context(process(*words)), samples_of(hours) // MACHINES)
        settle(server)
        figures = {**dict(_asked(site)), **dict(_browsed(site, _first_paint))}
        with at_work(partial(_work, endpoint, site, seconds_of(work))):
            site.cost(seconds)  # a server that gets to work again
            figures |= dict(_five(site, seconds))
            figures |= dict(_many(site, seconds))
    rows = [
        {"measured": name, "value": round(figures[name], 1), "goal": GOALS[name]} for name in GOALS if name in figures
    ]
    missing = {name: NO_BROWSER for name in GOALS if name not in figures}
    return {"benchmark": "web", "hours": hours, "seconds": seconds, **machine(), "rows": rows, "missing": missing}


@dataclass
class _Site:
    """The servers: port of the web server, process ids. sent: by each machine.

    acknowledged: when [ms since 1970] the machines had the acknowledgement of which row of the journal.
    """

    port: int
    server: int
    web: int
    sent: int
    acknowledged: list[tuple[float, int]] = field(default_factory=list)

    def get(self, path: str) -> bytes:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.request("GET", f"/api/v1/sites/{SITE.name}/{path}")
            answer = connection.getresponse()
            body = answer.read()
        finally:
            connection.close()
        if answer.status != HTTPStatus.OK:
            raise RuntimeError(f"{path}: {answer.status} {body[:200]!r}: nothing was measured")
        return body

    def info(self) -> Report:
        table: Report = json.loads(self.get("info"))
        return table

    def cost(self, seconds: float) -> tuple[float, float]:
        """Processor time of the web server and of the map server over so many seconds, in seconds per second."""
        before, began_s = (processor_s(self.web), processor_s(self.server)), time.monotonic()
        time.sleep(seconds)
        took_s = time.monotonic() - began_s
        web, server = (processor_s(pid) - s for pid, s in zip((self.web, self.server), before, strict=True))
        return web / took_s, server / took_s


class _Page(threading.Thread):
    """A page without a browser. seen: when it took in which row; asleep, it takes nothing after the first map."""

    def __init__(self, port: int, *, sleeps: bool = False) -> None:
        super().__init__(daemon=True)
        url = f"ws://127.0.0.1:{port}/api/v1/sites/{SITE.name}/live"
        self._opened = ExitStack()
        self._socket = self._opened.enter_context(open_socket(url, max_size=2**28, **QUIET))
        self._sleeps, self.seen = sleeps, list[tuple[float, int]]()
        self.start()

    def run(self) -> None:
        """Take in what comes, until closed."""
        with contextlib.suppress(ConnectionClosed):
            while not (self._sleeps and self.seen):
                if isinstance(data := self._socket.recv(), bytes):
                    head = json.loads(data[4 : 4 + struct.unpack(">I", data[:4])[0]])
                    self.seen.append((1e3 * time.time(), head["row"]))
                    if not self._sleeps:
                        self._socket.send(json.dumps({"row": head["row"], "fact": head["fact"]}))

    def close(self) -> None:
        """End the page."""
        self._opened.close()


@contextmanager
def _pages(port: int, count: int, sleepers: int = 0) -> Iterator[list[_Page]]:
    """Pages that are open, and have the map; the first ones sleep after it."""
    pages = [_Page(port, sleeps=i < sleepers) for i in range(count)]
    try:
        while not all(page.seen for page in pages):
            if not all(page.seen or page.is_alive() for page in pages):
                raise RuntimeError("a page was closed: nothing was measured")
            time.sleep(0.05)
        yield pages
    finally:
        for page in pages:
            page.close()


def _work(endpoint: str, site: _Site, seconds: Iterator[Batches], ended: threading.Event) -> None:
    """Ten machines at work: a batch each second, a pose four times a second."""
    sent = {f"loader-{i}": site.sent for i in range(1, MACHINES + 1)}
    with session(endpoint) as link:
        began_s = time.monotonic()
        for number, second in enumerate(seconds):
            for quarter in range(POSES):
                for name, rows in second:
                    _say(link, name, rows[-1], quarter / POSES)
                if quarter == 0:
                    for name, rows in second:
                        send(link, SITE, SampleBatch(name, 1, sent[name] + 1, rows, SITE.frame))
                        sent[name] += len(rows)
                    row = site.info()["journalled"]
                    site.acknowledged.append((1e3 * time.time(), row))
                left_s = began_s + number + (quarter + 1) / POSES - time.monotonic()
                if ended.wait(max(0.0, left_s)):
                    return


def _say(link: zenoh.Session, name: str, row: Any, later_s: float) -> None:
    """Where a machine is."""
    x_m, heading_rad = float(row["x_m"]) + SPEED_MPS * later_s, float(row["heading_rad"])
    variance = float(row["cov_xx_m2"])
    pose = Pose(name, int(row["stamp_ns"]), x_m, float(row["y_m"]), heading_rad, SPEED_MPS, variance, 0.0, variance)
    link.put(keys.pose(SITE.name, name), encode_pose(pose))


def _five(site: _Site, seconds: float) -> Figures:
    """What five pages cost, and how soon one paints what came in."""
    _, alone = site.cost(seconds)  # before anybody looks: nobody asks for tiles
    with _pages(site.port, PAGES):
        web, server = site.cost(seconds)
    yield "web server, five pages [% of a core]", 100 * web
    yield "map server, for five pages [ms/s]", 1e3 * max(0.0, server - alone)
    yield from _browsed(site, lambda site, context: _painting(site, context, seconds))


def _many(site: _Site, seconds: float) -> Figures:
    """Pages that sleep: what they cost in memory, and how far those that do not are behind."""
    with _pages(site.port, MANY, SLEEPERS) as pages:
        time.sleep(seconds / 2)
        first, before_mb = len(site.acknowledged), memory_mb(pid=site.web)
        time.sleep(seconds / 2)
        after_mb = memory_mb(pid=site.web)
        waited = [ms for page in pages[SLEEPERS:] for ms in _behind(site.acknowledged[first:], page.seen)]
    yield "pages behind the map, most [ms]", max(waited)
    yield "memory, while 10 of 50 pages sleep [MB]", after_mb - before_mb


def _behind(changes: Sequence[tuple[float, int]], seen: Sequence[tuple[float, int]]) -> list[float]:
    """Milliseconds from each change, a time and a row, until a page had seen it; not of those that it has not yet."""
    times, rows = [ms for ms, _ in seen], [row for _, row in seen]
    at = np.searchsorted(rows, [row for _, row in changes])
    return [max(0.0, times[i] - ms) for (ms, _), i in zip(changes, at, strict=True) if i < len(times)]


def _asked(site: _Site) -> Figures:
    """Maps of past hours, and XYZ tiles, each asked for twice."""
    info = site.info()
    hours = range(info["first_ns"] + HOUR_NS // 12, info["stamp_ns"] - HOUR_NS // 60, HOUR_NS)
    _, slider = (_ms(site, [f"tiles?as_of={stamp_ns}" for stamp_ns in hours]) for _ in range(2))
    yield "slider, cached hour, 95 % [ms]", slider
    west, south, east, north = (edge * SITE.cell_m for edge in info["bounds"] or (0, 0, 1, 1))
    draw, projection = np.random.default_rng(0), Projection(SITE)
    places = zip(draw.uniform(west, east, TILES), draw.uniform(south, north, TILES), strict=True)
    tiles = {_tile(*projection.to_geodetic(x, y)[:2]) for x, y in places}
    paths = [f"xyz/colour/resistance/{ZOOM}/{x}/{y}.png" for x, y in sorted(tiles)]
    yield "XYZ tile, fresh, 95 % [ms]", _ms(site, paths)
    yield "XYZ tile, cached, 95 % [ms]", _ms(site, paths)


def _tile(lat_deg: float, lon_deg: float) -> tuple[int, int]:
    """Column and row of the XYZ tile that a place lies in."""
    north = 1 - math.asinh(math.tan(math.radians(lat_deg))) / math.pi
    return int((lon_deg + 180.0) / 360.0 * 2**ZOOM), int(north / 2 * 2**ZOOM)


def _ms(site: _Site, paths: Sequence[str]) -> float:
    return 1e3 * float(np.percentile([timed(partial(site.get, path)) for path in paths], 95))


def _browsed(site: _Site, look: Callable[[_Site, Any], Figures]) -> Figures:
    """What a browser sees; nothing without one."""
    if CHROMIUM is None or find_spec("playwright") is None:
        return
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield from list(look(site, browser.new_context(viewport={"width": 1280, "height": 800})))
        browser.close()


def _first_paint(site: _Site, context: Any) -> Figures:
    """From the address to the map, in a browser that knows nothing of it; somebody looked at the map before."""
    site.get("tiles")
    page, counted = context.new_page(), [0.0]
    tools = context.new_cdp_session(page)
    tools.send("Network.enable")
    tools.on("Network.loadingFinished", lambda event: counted.append(event["encodedDataLength"]))
    received = "Network.webSocketFrameReceived"
    tools.on(received, lambda event: counted.append(len(event["response"]["payloadData"]) * 3 / 4))  # base64
    page.goto(f"http://127.0.0.1:{site.port}/")
    while not page.evaluate(PAINTED):
        page.wait_for_timeout(10)
    yield "first paint [ms]", page.evaluate("performance.now()")
    page.wait_for_timeout(500)
    yield "first paint [kB]", sum(counted) / 1e3


def _painting(site: _Site, context: Any, seconds: float) -> Figures:
    """How soon a page paints what came in."""
    page = context.new_page()
    page.goto(f"http://127.0.0.1:{site.port}/")
    while not page.evaluate(PAINTED):
        page.wait_for_timeout(10)
    page.evaluate(WATCH)
    first = len(site.acknowledged)
    with _pages(site.port, PAGES - 1):
        page.wait_for_timeout(1e3 * seconds)
        behind = _behind(site.acknowledged[first:], page.evaluate("window.seen"))
    yield "change to paint, 95 % [ms]", float(np.percentile(behind, 95))
