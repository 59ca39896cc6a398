"""A store that is served, to fill it or to look into it."""

from __future__ import annotations

import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from protocol.wire.session import free_endpoint
from sitegrid import Client, connect
from sitegrid.process.children import Children
from tests.paths import ROOT
from tests.patience import PATIENCE_S

MACHINES = ("loader-1", "loader-2")
X_M, Y_M = 8.5, 8.5


def version() -> str:
    """Of this checkout."""
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    return str(tomllib.loads(text)["project"]["version"])


@contextmanager
def served(folder: Path, children: Children) -> Iterator[tuple[Client, tuple[str | Path, ...]]]:
    """The folder's `store` behind a router of its own; yields a client, and options that an agent needs too."""
    endpoint = free_endpoint()
    site = folder / "store" / "site.toml"
    place = ("--endpoint", endpoint, "--site-file", site)
    children.start("router", "router", "--listen", endpoint).expect("ready", PATIENCE_S)
    server = children.start(
        "server", "server", *place, "--store", folder / "store", "--config", folder / "store" / "server.toml"
    )
    server.expect("ready", PATIENCE_S)
    with connect(endpoint, "pit", timeout_s=PATIENCE_S) as client:
        yield client, place
    assert server.stop() == 0
