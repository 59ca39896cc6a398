"""`sitegrid corrections`: relay a base's RTCM3, from its port or an NTRIP caster, to a site's receivers."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from contextlib import closing
from pathlib import Path

import zenoh

from protocol.config import from_table
from protocol.files import load_toml
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.session import open_session
from sitegrid.options.groups import add_network
from sitegrid.process.lifetime import note, plain, say, stop_flag
from sitegrid.security.join import join

HELP = "read RTCM3 of a base station or an NTRIP caster, for the receivers of a site"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_network(parser)
    where = "file that says where the base is (config/corrections.toml)"
    parser.add_argument("--config", type=Path, required=True, help=where)
    parser.add_argument("--site-file", type=Path, required=True, help="site file (config/site.toml)")


def run(arguments: Namespace) -> int:
    """Relay until stopped; the source may come and go."""
    from agents.corrections.relay import Relay, RelayConfig

    stop = stop_flag()
    config = from_table(RelayConfig, load_toml(arguments.config), str(arguments.config))
    site = load_site(arguments.site_file)
    joined = join(arguments.endpoint, arguments.keys, 30.0, role="corrections", name=config.name, site=site.name)
    with closing(open_session(joined)) as session:
        key, drop = keys.corrections(site.name, config.name), zenoh.CongestionControl.DROP  # superseded by the next one
        publisher = session.declare_publisher(key, congestion_control=drop)
        say({"ready": "corrections", "site": site.name, "name": config.name})
        report = Relay(publisher.put, config, site, stop.wait).run(stop)
    say({"ended": plain(report)}) if arguments.json else note(f"{config.name}: {report.get('frames', 0)} frames")
    return 0
