"""`sitegrid server`: the map server of one site."""

from __future__ import annotations

import time
from argparse import ArgumentParser, Namespace
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING

import zenoh

from protocol.config import from_table
from protocol.errors import LinkError
from protocol.files import load_toml
from protocol.site.site_file import load_site
from protocol.version import package_version
from protocol.wire.session import open_session, use_many_threads
from sitegrid.options.groups import add_network
from sitegrid.options.values import FOLDER, address
from sitegrid.process.lifetime import end_in_time, return_large_blocks, stop_flag, tell
from sitegrid.process.progress import compilation_reported, done_beside
from sitegrid.process.supervisor import say_ready, turns, until
from sitegrid.security.join import join, signer
from sitegrid.security.register import load_register

if TYPE_CHECKING:
    from mapserver.ingest.admission import Verify
    from mapserver.server import Server

HELP = "run the map server of a site"
EXTRA = "server"
FENCED = 3  # exit code after another server took over


class _StoppedError(Exception):
    """A signal came while waiting for another server."""


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add_network(parser)
    add("--site-file", type=Path, required=True, help="site file: name, origin, cells (config/site.toml)")
    add("--store", type=FOLDER, required=True, help="folder with journal, archive and snapshots")
    database = (
        "PostgreSQL database with the journal, postgresql://...: --store is a cache then, and further servers wait"
    )
    add("--journal", metavar="URL", default="", help=database)
    add("--config", type=Path, help="file with options (config/server.toml)")
    add("--signed", type=Path, metavar="KEYS", help="accept only signed batches; KEYS is the folder with the register")
    over = "have another map server of the site end, and take its place; without this, it stays, and this one ends"
    add("--take-over", action="store_true", help=over)
    usual = ("127.0.0.1", 9464)
    exports = f"serve Prometheus metrics over HTTP; without a value at {usual[0]}:{usual[1]}"
    add("--metrics", type=address, nargs="?", const=usual, metavar="[HOST:]PORT", help=exports)


def run(arguments: Namespace) -> int:
    """Serve until stopped; then finish pending batches, commit, snapshot."""
    from mapserver.config import ServerConfig
    from mapserver.journal.location import JournalLocation
    from mapserver.server import Server, warm_up, warm_up_rest

    stop = stop_flag()
    use_many_threads()
    return_large_blocks()
    site = load_site(arguments.site_file)
    table = load_toml(arguments.config) if arguments.config else {}
    config = from_table(ServerConfig, table, str(arguments.config))
    with ExitStack() as opened:
        opened.enter_context(compilation_reported())
        warm_up(config)
        opened.enter_context(done_beside(warm_up_rest(config)))
        joined = join(arguments.endpoint, arguments.keys, 30.0, role="server", site=site.name)
        ingest = opened.enter_context(closing(open_session(joined)))
        readers = opened.enter_context(closing(open_session(joined)))
        location = JournalLocation(arguments.store, arguments.journal)
        check, take_over = _verifier(arguments.signed), arguments.take_over
        key = signer(arguments.keys)
        sign = key.sign_reply if key else None
        said: list[str] = []

        is_stopped = until(stop)

        def standing_by(warm: bool) -> None:  # noqa: FBT001
            if warm and not said:
                said.append("standby")
                say_ready({"standby": "server", "site": site.name, "store": str(arguments.store)})
            if is_stopped():
                raise _StoppedError

        more = {"sign": sign, "take_over": take_over, "standing_by": standing_by}
        try:
            server = Server(ingest, readers, location, site, config, time.time_ns, check, **more)
        except _StoppedError:
            return 0
        opened.callback(server.close)
        ready = {"ready": "server", "site": site.name, "store": str(arguments.store)}
        if arguments.metrics:
            ready["metrics"] = _export(opened, readers, server, site.name, arguments)
        say_ready(ready)
        for _ in turns(stop, lives=server.lives):
            if server.failed:
                break
            if server.ended:
                raise LinkError(arguments.endpoint, f"{server.ended}; this one ends")
            if server.fenced:
                tell(f"sitegrid server: {location}: {server.fenced}; this one ends")
                end_in_time(FENCED)  # its database may hang
                return FENCED
    return 1 if server.failed else 0


def _verifier(keys: Path | None) -> Verify | None:
    """Verifier with the register's current keys."""
    if keys is None:
        return None
    from sitegrid.security.signing import Verifier  # `cryptography` is needed with keys only

    return Verifier(load_register(keys).signing_keys()).check


def _export(opened: ExitStack, session: zenoh.Session, server: Server, site: str, arguments: Namespace) -> str:
    """Serve metrics while the server runs; returns their address."""
    from mapserver.monitoring.exporter import Exporter
    from mapserver.monitoring.metrics import HealthListener, ServerCollector

    health = opened.enter_context(closing(HealthListener(session, site)))
    collector = ServerCollector(
        server.answers.info, health.received, server.changes, arguments.store, package_version()
    )
    return opened.enter_context(closing(Exporter(arguments.metrics, collector))).url
