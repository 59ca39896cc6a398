"""`sitegrid follow`: follow a site's journal and answer map queries."""

from __future__ import annotations

import re
import socket
import time
from argparse import ArgumentParser, Namespace
from contextlib import ExitStack, closing
from pathlib import Path

from protocol.config import from_table
from protocol.errors import LinkError
from protocol.files import load_toml
from protocol.site.site_file import load_site
from protocol.wire.keys import check_name
from protocol.wire.session import open_session, use_many_threads
from sitegrid.options.groups import add_network
from sitegrid.process.lifetime import return_large_blocks, stop_flag
from sitegrid.process.progress import compilation_reported, done_beside
from sitegrid.process.supervisor import say_ready, turns
from sitegrid.security.join import join

HELP = "follow a site's journal and answer queries of its map, so that the server need not"
EXTRA = "server"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add_network(parser)
    add("--site-file", type=Path, required=True, help="site file of the server: name, origin, cells")
    add("--store", type=Path, required=True, help="the server's store on this host, which is only read")
    database = "the server's database, postgresql://...; --store is a folder of this host then"
    add("--journal", metavar="URL", default="", help=database)
    add("--config", type=Path, help="the server's file with options (config/server.toml)")
    add("--name", help="name of this follower, another one for each (default the name of this host)")


def run(arguments: Namespace) -> int:
    """Follow until stopped."""
    from mapserver.config import ServerConfig
    from mapserver.follower.follower import Follower
    from mapserver.journal.location import JournalLocation
    from mapserver.server import warm_up, warm_up_rest

    stop = stop_flag()
    use_many_threads()
    return_large_blocks()
    site = load_site(arguments.site_file)
    table = load_toml(arguments.config) if arguments.config else {}
    config = from_table(ServerConfig, table, str(arguments.config))
    name = check_name(arguments.name or _host(), "--name")
    with ExitStack() as opened:
        opened.enter_context(compilation_reported())
        warm_up(config)
        opened.enter_context(done_beside(warm_up_rest(config)))
        joined = join(arguments.endpoint, arguments.keys, 30.0, role="follower", name=name, site=site.name)
        session = opened.enter_context(closing(open_session(joined)))
        journal = JournalLocation(arguments.store, arguments.journal)
        follower = opened.enter_context(closing(Follower(session, name, journal, site, config, time.time_ns)))
        is_ready = False
        for _ in turns(stop):
            if follower.ended:
                raise LinkError(f"follower {name}", f"{follower.ended}; this one ends")
            follower.tend()
            if follower.is_shown and not is_ready:
                is_ready = True
                say_ready({"ready": "follow", "site": site.name, "name": name, "store": str(arguments.store)})
    return 0


def _host() -> str:
    """The host name as a follower's name."""
    return re.sub(r"[^a-z0-9_-]+", "-", socket.gethostname().lower()).strip("-_")[:63] or "follower"
