"""`sitegrid server`: the map server of one site."""

from __future__ import annotations

import time
from argparse import Namespace

from mapserver.config import ServerConfig
from mapserver.server import Server
from protocol.config import from_table, load_toml
from protocol.session import open_session
from protocol.site import load_site
from sitegrid.process import say, stop_flag
from sitegrid.security import join


def run(arguments: Namespace) -> int:
    """Serve until stopped; then finish what has come in, commit, snapshot."""
    stop = stop_flag()
    site = load_site(arguments.site_file)
    table = load_toml(arguments.config) if arguments.config else {}
    config = from_table(ServerConfig, table, str(arguments.config))
    session = open_session(join(arguments.endpoint, arguments.keys, 30.0, role="server", site=site.name))
    server = Server(session, arguments.store, site, config, time.time_ns)
    say({"ready": "server", "site": site.name, "store": str(arguments.store)})
    while not stop.wait(0.5):
        if server.failed:
            break
    server.close()
    session.close()  # type: ignore[no-untyped-call]
    return 1 if server.failed else 0
