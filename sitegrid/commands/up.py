"""`sitegrid up`: router, map server, page and agent of a folder, a process each, until Ctrl-C."""

from __future__ import annotations

import re
import shlex
import sys
import threading
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from contextlib import closing, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import zenoh

from protocol.errors import MessageError
from protocol.wire import keys
from protocol.wire.codec import decode_health
from protocol.wire.session import DEFAULT_ENDPOINT, SessionConfig, free_endpoint, is_free, open_session
from sitegrid.health import line_of, status_of
from sitegrid.process.children import Child, Children, ProcessError
from sitegrid.process.lifetime import note, say, stop_flag
from sitegrid.process.status_line import StatusLine, status_line

if TYPE_CHECKING:
    from sitegrid.setup.files import Folder

HELP = "run router, map server, page and agent of a folder that `sitegrid init` has made, on this host"
EXTRA = "receivers,server,web"
READY_S = 300.0  # silence after which a process counts as hung; a first start compiles for a minute
COUNT = re.compile(r"\d+")


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    here = "folder with site.toml and agent.toml, where data and logs are kept too (default: this one)"
    parser.add_argument("folder", type=Path, nargs="?", default=Path(), metavar="FOLDER", help=here)


def run(arguments: Namespace) -> int:
    """Run everything; 0 after a signal, 1 if a process ends by itself."""
    from sitegrid.setup.files import Folder

    folder = Folder(arguments.folder)
    site, machine, _ = folder.load()
    stop = stop_flag(None)  # has children to stop
    folder.logs.mkdir(exist_ok=True)

    def meanwhile(line: dict[str, Any]) -> None:
        if "note" in line:
            note(str(line["note"]))
        if stop.is_set():
            raise KeyboardInterrupt

    try:
        with Children(folder.logs, meanwhile) as children:
            endpoint, url, running = _start(folder, site.name, children)
            if arguments.json:
                say({"ready": "up", "endpoint": endpoint, "url": url})
            else:
                note(f"the map is at {url} until Ctrl-C; data and logs: {folder.path.absolute()}")
                note(f"  sitegrid query --endpoint {endpoint} --site {site.name} machines")
            shown = status_line() if sys.stderr.isatty() and not arguments.json else nullcontext()
            with shown as line, closing(_Status(endpoint, site.name, machine.name, line)) as status:
                _watch(running, stop, status.show)
    except KeyboardInterrupt:
        pass
    note(f"all is ended; `sitegrid up {shlex.quote(str(arguments.folder))}` goes on from here")
    return 0


def _start(folder: Folder, site: str, children: Children) -> tuple[str, str, list[Child]]:
    """Start all parts; returns router endpoint, page address, processes."""
    from sitegrid.setup.files import PAGE, ROUTER

    endpoint, page = DEFAULT_ENDPOINT, PAGE
    if not is_free(ROUTER):
        endpoint = free_endpoint()
        note(f"port {ROUTER} is taken, perhaps by another router: this one listens at {endpoint}")
    if not is_free(PAGE):
        page = 0
        note(f"port {PAGE} is taken: the page takes another one")
    at, site_file = ("--endpoint", endpoint), ("--site-file", folder.site_file)
    beneath = ("--config", folder.page_file) if folder.page_file.exists() else ()  # outline, base map
    parts = {
        "router": ("--listen", endpoint),
        "server": (*at, *site_file, "--store", folder.store),
        "web": (*at, "--site", site, "--listen", page, *beneath),
        "agent": (*at, *site_file, "--config", folder.agent_file, "--spool", folder.spool),
    }
    running, url = list[Child](), ""
    for name, words in parts.items():
        note(f"{name} starts")
        child = children.start(name, name, *words, "--json")
        url = str(_ready(child).get("url", url))
        running.append(child)
    return endpoint, url, running


def _ready(child: Child) -> dict[str, Any]:
    """A process's ready message; ProcessError with its own words if it ends."""
    try:
        return child.expect("ready", READY_S)
    except ProcessError:
        if child.code is None or not (words := child.last_words()):
            raise
        raise ProcessError(child.name, words) from None


def _watch(running: list[Child], stop: threading.Event, show: Callable[[], None]) -> None:
    """Wait for a signal; ProcessError if a process ends first, except an agent at its recording's end."""
    while not stop.wait(0.25):
        show()
        for child in [child for child in running if child.code is not None]:
            if child.code or child.name != "agent":
                why = child.last_words() or "it logged nothing"
                raise ProcessError(child.name, f"ended with {child.code}, so all is ended: {why}")
            note("agent: its recording has ended; the map stays")
            running.remove(child)


class _Status:
    """Shows an agent's status: on a terminal in place, else every change."""

    def __init__(self, endpoint: str, site: str, machine: str, line: StatusLine | None) -> None:
        self._machine, self._line, self._shown = machine, line, ""
        self._session = open_session(SessionConfig(endpoint))
        self._health = self._session.declare_subscriber(keys.health(site, machine), zenoh.handlers.RingChannel(1))

    def show(self) -> None:
        """Show news."""
        if not (sample := self._health.try_recv()):
            return
        with suppress(MessageError, KeyError, TypeError):  # other versions
            values = decode_health(sample.payload.to_bytes()).values
            if self._line:
                self._line.show(line_of(self._machine, values))
            elif COUNT.sub("", said := status_of(values)) != COUNT.sub("", self._shown):
                self._shown = said
                note(f"{self._machine}: {said}")

    def close(self) -> None:
        """Leave the network."""
        self._session.close()  # type: ignore[no-untyped-call]
