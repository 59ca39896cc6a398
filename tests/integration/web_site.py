"""A site on the web: router, map server, web server as processes; machines drive on demand."""

from __future__ import annotations

import http.client
import json
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode, urlsplit

from protocol.queries.map_tiles import PLANES
from protocol.wire import keys
from protocol.wire.codec import decode_reply
from protocol.wire.messages import Ack
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sitegrid import Client, connect
from sitegrid.process.children import Child, Children
from tests.patience import PATIENCE_S
from tests.soak import BATCH_S, SITE_TOML, START_NS, SoakMachine

NAME = "soak"


@dataclass(frozen=True)
class Answer:
    status: int
    headers: Mapping[str, str]
    body: bytes

    @property
    def json(self) -> Any:
        return json.loads(self.body)


class WebSite:
    """Everything runs at once, machines by `drive`."""

    def __init__(self, folder: Path, children: Children, *words: str | Path, machines: int = 3) -> None:
        self.folder, self.children = folder, children
        self.endpoint = free_endpoint()
        (folder / "site.toml").write_text(SITE_TOML)
        # Maps depend on sent samples, not on the solver's timing.
        (folder / "server.toml").write_text("[calibration]\nautomatic = false\n")
        self.router = self.start_router()
        self.server = self.start_server()
        self.web = self.start_web(*words)
        self.machines = [SoakMachine(f"machine-{i}", seed=i) for i in range(machines)]
        self.driven_s = 0.0
        self.session = open_session(SessionConfig(self.endpoint))
        children.callback(self.session.close)
        self.client: Client = children.enter_context(connect(self.endpoint, NAME, timeout_s=PATIENCE_S))

    def start_router(self) -> Child:
        child = self.children.start("router", "router", "--listen", self.endpoint)
        child.expect("ready", PATIENCE_S)
        return child

    def start_server(self) -> Child:
        files = ("--site-file", self.folder / "site.toml", "--config", self.folder / "server.toml")
        words = (*files, "--store", self.folder / "store")
        child = self.children.start("server", "server", "--endpoint", self.endpoint, *words)
        child.expect("ready", PATIENCE_S)
        return child

    def start_web(self, *words: str | Path, port: int = 0) -> Child:
        listen = ("--listen", str(port), "--site", NAME)
        child = self.children.start("web", "web", "--endpoint", self.endpoint, *listen, *words)
        self.url = child.expect("ready", PATIENCE_S)["url"]
        return child

    @property
    def port(self) -> int:
        return urlsplit(self.url).port or 0

    def drive(self, seconds: float) -> None:
        """Drive all machines on until acknowledged."""
        end_s = self.driven_s + seconds
        while self.driven_s < end_s:
            for machine in self.machines:
                batch = machine.drive(self.driven_s, self.client.info().site.frame)
                while True:
                    replies = self.session.get(keys.ingest(NAME, machine.name), payload=batch, timeout=60.0)
                    if any(r.ok and isinstance(decode_reply(r.ok.payload.to_bytes()), Ack) for r in replies):
                        break
            self.driven_s += BATCH_S

    @property
    def now_ns(self) -> int:
        return START_NS + round(self.driven_s * 1e9)

    def get(self, path: str, parameters: Mapping[str, object] | None = None, **headers: str) -> Answer:
        """GET a path of the site's API, or any path with leading slash."""
        if not path.startswith("/"):
            path = f"/api/v1/sites/{NAME}/{path}"
        query = f"?{urlencode(parameters)}" if parameters else ""
        return self.request("GET", path + query, headers)

    def request(self, method: str, target: str, headers: Mapping[str, str] = {}, body: bytes = b"") -> Answer:
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        try:
            connection.request(method, target, body or None, {name.replace("_", "-"): v for name, v in headers.items()})
            response = connection.getresponse()
            return Answer(response.status, {k.lower(): v for k, v in response.getheaders()}, response.read())
        finally:
            connection.close()

    def live_url(self, **known: object) -> str:
        query = f"?{urlencode(known)}" if known else ""
        return f"ws://127.0.0.1:{self.port}/api/v1/sites/{NAME}/live{query}"


@dataclass
class Frame:
    """Tiles as received by a page."""

    head: dict[str, Any]
    tiles: dict[tuple[int, int], tuple[int, bytes]]

    @classmethod
    def read(cls, data: bytes) -> Frame:
        (length,) = struct.unpack(">I", data[:4])
        head = json.loads(data[4 : 4 + length])
        offset, tiles = 4 + length, {}
        for tile in head["tiles"]:
            planes = zlib.decompress(data[offset : offset + tile["bytes"]])
            assert len(planes) == len(PLANES) * 64 * 64
            tiles[tile["x"], tile["y"]] = tile["newest_ns"], planes
            offset += tile["bytes"]
        assert offset == len(data)
        return cls(head, tiles)

    @property
    def version(self) -> tuple[int, int]:
        return self.head["row"], self.head["fact"]
