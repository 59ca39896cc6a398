"""`sitegrid log`: usability of a machine's recording, and accuracy of positions from it."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from functools import partial
from pathlib import Path

from sitegrid.options.groups import add_action
from sitegrid.options.values import PICTURE, count_or_names, names, setting, taken, withhold
from sitegrid.process.lifetime import note, plain, say, tell
from sitegrid.process.streams import lines, table

HELP = "check a recording of a machine, replay it, or convert one of ROS or a receiver"
EXTRA = "agent"
BESIDE = {"cv2": "server", "rosbags": "recordings"}  # for --picture, and for bags


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    what = parser.add_subparsers(metavar="WHAT", required=True, dest="what")
    check = add_action(what, "check", "say what of a log folder is usable, and why the rest is not")
    run = add_action(what, "run", "replay a log folder: positions without GPS, against a truth, and on known ground")
    for action in (check, run):
        action.add_argument("manifest", type=Path, metavar="FOLDER", help="folder with log.toml, or that file")
        action.add_argument("--data", type=Path, help="folder with the CSV files, if not beside the manifest")
    _add_options_of_run(run)
    _add_options_of_convert(add_action(what, "convert", "make a log folder of a bag of ROS, MCAP, NMEA, UBX or GPX"))


def _add_options_of_convert(convert: ArgumentParser) -> None:
    file = "bag of ROS 1 or 2, MCAP file of ROS 2, bytes of a receiver, or GPX"
    convert.add_argument("file", type=Path, metavar="FILE", help=file)
    folder = "is made; one that exists is refused (default: the name of FILE without its ending, here)"
    convert.add_argument("folder", type=Path, nargs="?", metavar="FOLDER", help=folder)
    take = (
        "kinds of sensors that a topic feeds, as /odom=odometry, /imu=imu,attitude, /odom=none or "
        "'/joint_states[left,right]=encoder'; may be repeated (default: what can be but one thing)"
    )
    convert.add_argument("--take", action="append", type=taken, default=[], metavar="TOPIC=KIND", help=take)


def _add_options_of_run(run: ArgumentParser) -> None:
    off = (
        "OFF/PERIOD: no GPS for OFF seconds in every PERIOD; START,LENGTH: once, for LENGTH seconds; none: all of it; "
        "may be repeated, a row each (default none, 1/10, 10/30, 30/60)"
    )
    run.add_argument("--withhold", action="append", type=withhold, metavar="WHEN", help=off)
    sensors = "names of the sensors to use, comma-separated, and no others (default: as the manifest says)"
    run.add_argument("--sensors", type=names, default=(), metavar="NAMES", help=sensors)
    receivers = "of the GPS receivers, how many to use, or which, by name, comma-separated"
    run.add_argument("--gps", type=count_or_names, default=(), metavar="N|NAMES", help=receivers)
    run.add_argument("--filter", choices=("ekf", "ukf"), default="ukf", help="filter (default %(default)s)")
    profile = "filter profile (default %(default)s)"
    run.add_argument("--profile", choices=("default", "paper"), default="default", help=profile)
    option = "an option of [pipeline.localisation] in agent.toml, as start=[0,0,1.57]; may be repeated"
    run.add_argument("--set", action="append", type=setting, default=[], metavar="NAME=VALUE", help=option)
    run.add_argument("--picture", type=PICTURE, metavar="FILE.png", help="draw the first row: track, fixes, truth")


def run(arguments: Namespace) -> int:
    """Check, replay, or convert a recording."""
    if arguments.what == "convert":
        from sitegrid.convert.command import run as convert

        return convert(arguments)
    return _check(arguments) if arguments.what == "check" else _run(arguments)


def _check(arguments: Namespace) -> int:
    """Report usability; 1 if nothing can run."""
    from sitegrid.logs.check import examine

    examined = examine(arguments.manifest, arguments.data)
    if arguments.json:
        say(plain({"ok": examined.ok, **vars(examined)}))
    else:
        tell(table(examined.rows), "", f"begins: {examined.begins or 'never'}", "", *examined.findings)
    return 0 if examined.ok else 1


def _run(arguments: Namespace) -> int:
    from agents.localisation.localiser import LocalisationConfig
    from protocol.config import from_table
    from sitegrid.logs import outages
    from sitegrid.logs.run import measurements, read_recording, run
    from sitegrid.logs.sensors import chosen

    draw = None
    if arguments.picture:
        from sitegrid.logs.picture import draw_log  # before the work: OpenCV may be missing

        draw = partial(draw_log, arguments.picture)
    named = {"filter": arguments.filter, "profile": arguments.profile, **dict(arguments.set)}
    options = from_table(LocalisationConfig, named, "--set")
    patterns = [outages.parse_pattern(*words) for words in arguments.withhold or ()] or outages.WITHHOLD
    choose = partial(chosen, sensors=arguments.sensors, gps=arguments.gps)
    recording = read_recording(arguments.manifest, arguments.data, choose)
    report = run(recording, options, patterns, on_progress=note, draw=draw)
    if arguments.json:
        say(plain(report))
    else:
        missing = report.pop("missing")
        shown = {**report, "measurements": measurements(report["rows"])}
        tell("\n\n".join([*lines(plain(shown)), *(f"{name}: {why}" for name, why in missing.items())]))
    return 0
