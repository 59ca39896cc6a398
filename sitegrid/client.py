"""The Python client of the map. It needs the base install only.

with sitegrid.connect("tcp/127.0.0.1:7447", "paper") as site:
    ground = site.region((0, 0, 200, 150), ["resistance"])
"""

from __future__ import annotations

from collections.abc import Sequence
from types import TracebackType
from typing import Any

import zenoh

from protocol import keys
from protocol.errors import LinkError
from protocol.geometry import Bounds
from protocol.queries import (
    Freshness,
    InfoQuery,
    MapQuery,
    PointAnswer,
    PointQuery,
    Region,
    RegionQuery,
    decode_error,
    decode_info,
    decode_point,
    decode_region,
    encode_query,
)
from protocol.session import DEFAULT_ENDPOINT, SessionConfig, open_session


class Client:
    """Asks the map server of one site. Every call may raise QueryError (refused) or LinkError (no answer)."""

    def __init__(self, session: zenoh.Session, endpoint: str, site: str, timeout_s: float = 10.0) -> None:
        self.session = session
        self.site = site
        self._endpoint = endpoint
        self._timeout_s = timeout_s

    def point(
        self, x_m: float, y_m: float, layers: Sequence[str] = (), *, after: int = 0, wait_s: float = 10.0
    ) -> PointAnswer:
        """Layers of the cell at a position in `map`; NaN is unknown.

        layers: names, none for all. after: wait until this journal row is merged, at most wait_s.
        """
        query = PointQuery(float(x_m), float(y_m), tuple(layers), Freshness(after, wait_s))
        return decode_point(self._ask(query))

    def region(
        self,
        bounds: Bounds | tuple[float, float, float, float],
        layers: Sequence[str] = (),
        *,
        after: int = 0,
        wait_s: float = 10.0,
    ) -> Region:
        """Layers of all cells that a rectangle (west, south, east, north) [m] touches, as arrays with coordinates."""
        box = bounds if isinstance(bounds, Bounds) else Bounds(*(float(v) for v in bounds))
        return decode_region(self._ask(RegionQuery(box, tuple(layers), Freshness(after, wait_s))))

    def info(self, *, after: int = 0, wait_s: float = 10.0) -> dict[str, Any]:
        """State of the map and its server: site, rows journalled and merged, machines, counters, layers."""
        return decode_info(self._ask(InfoQuery(Freshness(after, wait_s))))

    def close(self) -> None:
        """Close the session."""
        self.session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _ask(self, query: MapQuery) -> bytes:
        key = keys.map_query(self.site, query.name)
        parameters = ";".join(f"{name}={value}" for name, value in encode_query(query).items())
        wait_s = query.fresh.wait_s if query.fresh.after else 0.0
        selector = zenoh.Selector(key, parameters) if parameters else zenoh.Selector(key)
        for reply in self.session.get(selector, timeout=self._timeout_s + wait_s):
            if reply.ok is not None:
                return reply.ok.payload.to_bytes()
            if reply.err is not None:
                raise decode_error(reply.err.payload.to_bytes())
        problem = f"no map server answers for site {self.site!r}: start one with `sitegrid server`, or check the name"
        raise LinkError(self._endpoint, problem)


def connect(endpoint: str = DEFAULT_ENDPOINT, site: str = "paper", *, timeout_s: float = 10.0) -> Client:
    """Connect to the router at `endpoint` and ask for the map of `site`; LinkError if no router is there."""
    return Client(open_session(SessionConfig(endpoint)), endpoint, site, timeout_s)
