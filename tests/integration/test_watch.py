"""A program watches the map while server and router are killed; the bits finally agree."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

import numpy as np
import pytest

from protocol.queries.answers import Region
from protocol.site.geometry import Bounds
from sitegrid import connect
from sitegrid.process.children import Child
from tests.integration.forks import Forks
from tests.integration.web_site import NAME, WebSite
from tests.patience import PATIENCE_S, until

LAYERS = ("resistance", "grade_filled", "visits", "weight")
SIDE_M = 256.0
TEN_MINUTES_S = 600


class Watched:
    """What a program saw, on its own thread."""

    def __init__(self, site: WebSite, children: Forks) -> None:
        self.bounds = Bounds(-SIDE_M, -SIDE_M, SIDE_M, SIDE_M)
        self.client = children.enter_context(connect(site.endpoint, NAME, timeout_s=2.0))
        size = round(2 * SIDE_M)
        self.layers = {name: np.full((size, size), np.nan, np.float32) for name in LAYERS}
        self.regions = 0
        self.stop = threading.Event()
        self._thread = threading.Thread(target=self._look)
        self._thread.start()
        children.callback(self._end)

    def _look(self) -> None:
        for region in self.client.watch(self.bounds, LAYERS, again_s=0.2, stop=self.stop):
            row, column = (round(edge + SIDE_M) for edge in (region.bounds.south_m, region.bounds.west_m))
            for name, values in region.layers.items():
                self.layers[name][row : row + values.shape[0], column : column + values.shape[1]] = values
            self.regions += 1

    def is_all_of(self, region: Region) -> bool:
        return all(values.tobytes() == region[name].tobytes() for name, values in self.layers.items())

    def _end(self) -> None:
        self.stop.set()
        self._thread.join()


def killed(child: Child) -> None:
    child.send(signal.SIGKILL)
    child.wait(PATIENCE_S)


@pytest.mark.nightly
@pytest.mark.processes
def test_a_watched_map_is_the_map_after_server_and_router_were_killed(tmp_path: Path):
    with Forks(tmp_path) as children:
        site = WebSite(tmp_path, children)
        watched = Watched(site, children)
        for step in range(TEN_MINUTES_S // 20):
            site.drive(20)
            if step == 8:
                killed(site.server)
                site.server = site.start_server()
            if step == 16:
                killed(site.router)
                site.router = site.start_router()
        until(lambda: watched.is_all_of(site.client.region(watched.bounds, LAYERS)), "what is watched is the map")
        assert watched.regions > 30
