"""Outline and base map beneath the live page's map. Needs Chromium (Debian: `chromium`)."""

from __future__ import annotations

import http.server
import json
import re
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from protocol.wire.session import free_endpoint
from tests.integration.browser_tab import Tab, needs_browser
from tests.integration.web_site import NAME, WebSite
from tests.patience import PATIENCE_S, until

pytestmark = needs_browser
GREEN = bytes(cv2.imencode(".png", np.full((256, 256, 3), (0, 255, 0), np.uint8))[1].tobytes())
AWAY = -60.0, -60.0  # where nobody drives


@pytest.fixture
def tiles() -> Iterator[tuple[str, list[str]]]:
    """A server of green tiles, and the paths that were asked for."""
    asked: list[str] = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_response(200)
            self.end_headers()
            self.wfile.write(GREEN)

        def log_message(self, *_: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}", asked
        server.shutdown()


def page_of(web: WebSite, folder: Path, toml: str) -> str:
    """The address of another page of the site, so configured."""
    square = [[-80, -80], [-40, -80], [-40, -40], [-80, -40], [-80, -80]]
    (folder / "site.geojson").write_text(json.dumps({"type": "Polygon", "coordinates": [square]}))
    (folder / "site.png").write_bytes(GREEN)
    (folder / "web.toml").write_text(f'[{NAME}]\noutline = "site.geojson"\nunits = "metres"\n{toml}\n')
    words = ("--endpoint", web.endpoint, "--listen", "0", "--site", NAME, "--config", folder / "web.toml")
    return str(web.children.start(folder.name, "web", *words).expect("ready", PATIENCE_S)["url"])


def is_green(tab: Tab, x_m: float, y_m: float, width: int = 1, height: int = 1) -> bool:
    """Whether all pixels right of and below a place are green."""
    tab.drawn()
    left, top = tab.pixel_of(x_m, y_m)
    clip = {"x": round(left), "y": round(top), "width": width, "height": height}
    shown = cv2.imdecode(np.frombuffer(tab.page.screenshot(clip=clip), np.uint8), cv2.IMREAD_COLOR).astype(int)
    return bool((shown[..., 1] - shown[..., 2] > 40).all())


def test_a_picture_and_the_outline_lie_beneath_the_map(browser, web: WebSite, tmp_path: Path):
    url = page_of(web, tmp_path, 'base_map = "site.png"\nbounds = [-100, -100, 0, 0]\nattribution = "Survey, 2026"')
    tab = Tab(browser, url).loaded()
    tab.until("sitegrid.site.backdrop !== null")
    tab.js(f"sitegrid.view.look({AWAY[0]}, {AWAY[1]}, 4)")
    until(lambda: is_green(tab, *AWAY), "the picture")
    assert not is_green(tab, 20, -60), "it ends where its bounds do"
    assert not is_green(tab, -40, -60), "the outline"
    assert tab.page.locator("#attribution").inner_text() == "Survey, 2026"
    tab.page.keyboard.press("p")
    assert not is_green(tab, *AWAY)
    assert tab.complaints == []
    tab.close()


def test_tiles_come_from_their_server_alone(browser, web: WebSite, tmp_path: Path, tiles: tuple[str, list[str]]):
    server, paths = tiles
    url = page_of(web, tmp_path, f'base_map = "{server}/ortho/{{z}}/{{x}}/{{y}}.png"\nmax_zoom = 18')
    tab = Tab(browser, url).loaded()
    tab.until("sitegrid.site.backdrop !== null")
    tab.js("sitegrid.view.look(-60, -160, 4)")
    until(lambda: is_green(tab, -60, -160, 500, 100), "tiles side by side; one is 400 pixels wide")
    other = f"Object.assign(new Image(), {{ src: '{server}/elsewhere.png', onerror: () => done(true), onload: done }})"
    assert tab.js(f"new Promise((done) => {other})") is True, "the policy allows nothing else"
    assert paths
    assert all(re.fullmatch(r"/ortho/1[678]/\d+/\d+\.png", path) for path in paths), "max_zoom, and coarser ones"
    tab.close()


def test_a_base_map_that_cannot_be_loaded_is_named_once_and_the_page_goes_on(browser, web: WebSite, tmp_path: Path):
    nobody = free_endpoint().replace("tcp/", "http://")
    url = page_of(web, tmp_path, f'base_map = "{nobody}/{{z}}/{{x}}/{{y}}.png"')
    tab = Tab(browser, url).loaded()
    tab.until("document.getElementById('notice').textContent.includes('The base map cannot be loaded')")
    assert all("ERR_CONNECTION_REFUSED" in complaint for complaint in tab.complaints)
    tab.until("document.getElementById('notice').hidden")
    tab.complaints.clear()
    tab.js("sitegrid.view.shift(2000, 0)")

    def is_refused_again() -> bool:
        tab.drawn()
        return bool(tab.complaints)

    until(is_refused_again, "more tiles that do not come")
    assert tab.page.locator("#notice").is_hidden(), "once"
    assert tab.js("sitegrid.site.state") == "live"
    tab.close()


def test_nothing_is_allowed_that_is_not_configured(web: WebSite):
    policy = web.get("/").headers["content-security-policy"]
    assert policy.endswith("img-src 'self' data: blob:")
    assert web.get("backdrop").json == {"outline": [], "base_map": None, "attribution": ""}
    assert web.get("base_map").status == 404
