"""`sitegrid log`: what a recording of a real machine shows."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial
from pathlib import Path

from sitegrid.options.groups import add_action
from sitegrid.options.values import count_or_names, names, setting, withhold
from sitegrid.process.lifetime import note, plain, say, tell
from sitegrid.process.tables import lines

HELP = "look into a recording of a real machine"
EXTRA = "agent"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    what = parser.add_subparsers(metavar="WHAT", required=True, dest="what")
    log = add_action(what, "run", "replay a recording and compare with withheld fixes or with its ground truth")
    log.add_argument("manifest", type=Path, metavar="MANIFEST", help="log.toml, or its folder")
    log.add_argument("--data", type=Path, help="folder with the CSV files, if not beside the manifest")
    off = (
        "OFF/PERIOD: no GPS for OFF seconds in every PERIOD; START,LENGTH: once, for LENGTH seconds; none: all of it; "
        "may be repeated, a row each (default none, 1/10, 10/30, 30/60)"
    )
    log.add_argument("--withhold", action="append", type=withhold, metavar="WHEN", help=off)
    sensors = "names of the sensors to use, comma-separated, and no others (default: as the manifest says)"
    log.add_argument("--sensors", type=names, default=(), metavar="NAMES", help=sensors)
    receivers = "of the GPS receivers, how many to use, or which, by name, comma-separated"
    log.add_argument("--gps", type=count_or_names, default=(), metavar="N|NAMES", help=receivers)
    log.add_argument("--filter", choices=("ekf", "ukf"), default="ukf", help="filter (default %(default)s)")
    profile = "filter profile (default %(default)s)"
    log.add_argument("--profile", choices=("default", "paper"), default="default", help=profile)
    option = "an option of [pipeline.localisation] in agent.toml, as start=[0,0,1.57]; may be repeated"
    log.add_argument("--set", action="append", type=setting, default=[], metavar="NAME=VALUE", help=option)


def run(arguments: Namespace) -> int:
    """Replay a log."""
    from agents.localisation.localiser import LocalisationConfig
    from protocol.config import from_table
    from sitegrid.logs import real_logs
    from sitegrid.logs.sensors import chosen

    named = {"filter": arguments.filter, "profile": arguments.profile, **dict(arguments.set)}
    options = from_table(LocalisationConfig, named, "--set")
    patterns = [real_logs.parse_pattern(*words) for words in arguments.withhold or ()] or real_logs.WITHHOLD
    choose = partial(chosen, sensors=arguments.sensors, gps=arguments.gps)
    report = real_logs.run(arguments.manifest, arguments.data, options, patterns, choose, on_progress=note)
    shown = report if arguments.json else {**report, "measurements": real_logs.measurements(report["rows"])}
    if arguments.json:
        say(plain(report))
    else:
        tell("\n\n".join(lines(plain(shown))))
    return 0
