"""The `sitegrid` command: noun first, quiet by default, `--json` for machines.

Exit codes: 0 ok, 1 failed, 2 usage. Each sub-command imports what it needs only when it runs, so that the base install
serves the client and `--help` is quick.
"""

from __future__ import annotations

import argparse
import importlib
import json
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

from protocol.errors import SitegridError
from protocol.wire.session import DEFAULT_ENDPOINT
from sitegrid.commands.arguments import address, count, days, not_negative, positive, seed, withhold
from sitegrid.commands.times import HELP as TIME_HELP
from sitegrid.commands.times import STAMP_HELP, parse_stamp, parse_time
from sitegrid.process.logs import start_logging

METRICS_PORT = 9464
EXTRA = {
    "numba": "server",
    "cv2": "server",
    "filterpy": "agent",
    "pyproj": "agent",
    "rich": "sim",
    "pybullet": "sim",
    "scipy": "eval",
    "matplotlib": "eval",
    "cryptography": "security",
}


def main(words: Sequence[str] | None = None) -> int:
    """Run the command; errors in one line."""
    arguments = build_parser().parse_args(words)
    start_logging(verbose=arguments.verbose)
    try:
        module = importlib.import_module(arguments.module)
        return int(module.run(arguments))
    except SitegridError as error:
        return _fail(str(error), arguments.json)
    except ModuleNotFoundError as error:
        extra = EXTRA.get(str(error.name))
        if not extra:
            raise
        return _fail(f"{error.name} is not installed: pip install 'sitegrid[{extra}]'", arguments.json)
    except KeyboardInterrupt:
        return 130


def build_parser() -> argparse.ArgumentParser:
    """The parser of all sub-commands."""
    common = argparse.ArgumentParser(add_help=False)
    common.add_argument("--json", action="store_true", help="print JSON for machines")
    common.add_argument("--verbose", action="store_true", help="log what happens, not only what goes wrong")
    network = argparse.ArgumentParser(add_help=False)
    network.add_argument("--endpoint", default=DEFAULT_ENDPOINT, help="router to connect to (default %(default)s)")
    network.add_argument(
        "--keys",
        type=Path,
        metavar="FOLDER",
        help="keys of this process (`sitegrid keys`); the endpoint is tls/... then",
    )
    parser = argparse.ArgumentParser(prog="sitegrid", description="Many machines draw one map of the ground together.")
    nouns = parser.add_subparsers(metavar="COMMAND", required=True)
    for add in (
        _add_demo,
        _add_router,
        _add_keys,
        _add_server,
        _add_sim,
        _add_agent,
        _add_query,
        _add_doctor,
        _add_trust,
        _add_plot,
        _add_eval,
        _add_fold,
    ):
        add(nouns, common, network)
    return parser


Nouns: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"  # noqa: SLF001 - it has no public name
Parent: TypeAlias = argparse.ArgumentParser


def _add_demo(nouns: Nouns, common: Parent, _: Parent) -> None:
    demo = _noun(nouns, "demo", "router, map server, simulator and agents, each its own process; pictures", [common])
    demo.add_argument("--seconds", type=positive, default=240.0, help="simulated time (default %(default)s)")
    demo.add_argument("--speed", type=positive, default=4.0, help="times real time (default %(default)s)")
    demo.add_argument("--scenario", default="paper_site", help="what is simulated (default %(default)s)")
    demo.add_argument("--world", choices=("pybullet", "fast"), help="what moves the machines (over the scenario)")
    demo.add_argument("--machines", type=int, help="machines of the scenario's first fleet (over the scenario)")
    demo.add_argument("--seed", type=int, help="seed of the simulation (over the scenario)")
    demo.add_argument("--out", type=Path, default=Path("demo-output"), help="folder for pictures and stores")
    demo.add_argument("--headless", action="store_true", help="no live display, plain lines only")
    demo.add_argument("--log", type=Path, help="manifest of a real log that a further agent replays")
    demo.add_argument("--data", type=Path, help="folder with the CSV files of that log")
    demo.add_argument("--no-log", action="store_true", help="replay no log, also where the default one exists")


def _add_router(nouns: Nouns, common: Parent, _: Parent) -> None:
    router = _noun(nouns, "router", "the site's Zenoh router", [common])
    router.add_argument("--listen", default=DEFAULT_ENDPOINT, help="where to listen (default %(default)s)")
    safety = router.add_mutually_exclusive_group()
    safety.add_argument(
        "--keys", type=Path, metavar="KEYS", help="folder of the site's keys; it listens on tls/... then"
    )
    safety.add_argument("--insecure", action="store_true", help="listen beyond this host, although there are no keys")


def _add_keys(nouns: Nouns, common: Parent, _: Parent) -> None:
    keys = _noun(nouns, "keys", "the certificates of a site: who is let in, as what", [common])
    actions = keys.add_subparsers(metavar="ACTION", required=True, dest="action")
    quiet = _quiet()
    init = actions.add_parser("init", help="the site's authority, its router and its map server", parents=[quiet])
    init.add_argument("--site", default="paper", help="name of the site (default %(default)s)")
    init.add_argument(
        "--host", nargs="+", action="extend", default=[], help="names and addresses that the router is reached at"
    )
    add = actions.add_parser("add", help="keys for a machine, or another that is to be let in", parents=[quiet])
    roles = ("machine", "visitor", "server", "admin", "sim")
    add.add_argument("--role", choices=roles, help="what it may do (default machine)")
    add.add_argument(
        "--renew", action="store_true", help="a new certificate for one that has it; the old one stays valid"
    )
    revoke = actions.add_parser("revoke", help="let it in no more", parents=[quiet])
    for action in (add, revoke):
        action.add_argument("name", metavar="MACHINE")
    for action in (init, add):
        action.add_argument("--days", type=days, default=365, help="how long it is valid (default %(default)s)")
    for action in (init, add, revoke, actions.add_parser("list", help="who is let in, until when", parents=[quiet])):
        action.add_argument("--dir", type=Path, default=Path("keys"), help="folder of the keys (default %(default)s)")


def _add_server(nouns: Nouns, common: Parent, network: Parent) -> None:
    server = _noun(nouns, "server", "the map server of a site", [common, network])
    server.add_argument(
        "--site-file", type=Path, required=True, help="the site: name, origin, cells (config/site.toml)"
    )
    server.add_argument("--store", type=Path, required=True, help="folder of the journal and its snapshots")
    server.add_argument("--config", type=Path, help="options (config/server.toml)")
    server.add_argument(
        "--signed", type=Path, metavar="KEYS", help="take only batches that are signed, by the register in this folder"
    )
    server.add_argument(
        "--metrics",
        type=address,
        nargs="?",
        const=("127.0.0.1", METRICS_PORT),
        metavar="[HOST:]PORT",
        help=f"show metrics for Prometheus over HTTP, to this host unless HOST is given (port {METRICS_PORT})",
    )


def _add_sim(nouns: Nouns, common: Parent, network: Parent) -> None:
    sim = _noun(nouns, "sim", "the simulator: machines drive, their sensors are published", [common, network])
    sim.add_argument("--config", type=Path, help="options (config/sim.toml)")
    sim.add_argument("--scenario", help="name of a scenario, or the path of its .toml file (over the config)")
    sim.add_argument("--world", choices=("pybullet", "fast"), help="what moves the machines (over the scenario)")
    sim.add_argument("--preset", help="paper, dgps, standalone, rtk, harsh: how bad sensors are (over the scenario)")
    for name, kind, what in (
        ("seconds", float, "simulated time, 0 until stopped"),
        ("speed", float, "times real time, 0 as fast as possible"),
        ("machines", int, "machines of the scenario's first fleet"),
        ("seed", int, "seed"),
    ):
        sim.add_argument(f"--{name}", type=kind, help=f"{what} (over the config)")
    sim.add_argument("--site", help="name of the site in keys (over the config)")
    sim.add_argument("--truth", type=Path, help="folder to write the true map and tracks to")
    sim.add_argument("--record", type=Path, help="folder to write a log folder per machine to, instead of publishing")
    sim.add_argument("--all-sensors", action="store_true", help="every GPS receiver and IMU that the machines have")
    sim.add_argument("--picture", type=Path, help="draw the site from above and in perspective into this file, and end")
    sim.add_argument("--write-configs", type=Path, help="write site.toml and one agent file per machine, and end")


def _add_agent(nouns: Nouns, common: Parent, network: Parent) -> None:
    agent = _noun(nouns, "agent", "the localisation agent of one machine", [common, network])
    agent.add_argument("--config", type=Path, help="machine, sensors and options (config/agent.toml)")
    agent.add_argument("--site-file", type=Path, help="the site (config/site.toml); a log brings its own")
    agent.add_argument("--name", help="name of the machine (over the config)")
    agent.add_argument("--spool", type=Path, required=True, help="file of the spool")
    agent.add_argument("--audit", type=Path, help="file that notes every recorded sample")
    agent.add_argument("--calibration", type=Path, help="file that keeps the calibration (beside the spool)")
    agent.add_argument("--driver", choices=("zenoh", "replay"), default="zenoh", help="where readings come from")
    agent.add_argument("--log", type=Path, help="replay: manifest of the log")
    agent.add_argument("--data", type=Path, help="replay: folder with the CSV files, if not beside the manifest")
    agent.add_argument("--speed", type=not_negative, default=1.0, help="replay: times real time, 0 at once")
    agent.add_argument(
        "--withhold", action="store_true", help="withhold GPS ([holdout]) and report the error against it"
    )


def _add_doctor(nouns: Nouns, common: Parent, network: Parent) -> None:
    doctor = _noun(nouns, "doctor", "what is wrong with this host's part of a site, and what to do", [common, network])
    doctor.add_argument("--site", help="name of the site (default: that of the site file or the keys, else paper)")
    doctor.add_argument("--site-file", type=Path, help="the site, to compare with that of the map server (site.toml)")
    doctor.add_argument("--machine", help="name to ask for its watermark under (default: that of the keys)")
    doctor.add_argument("--spool", type=Path, help="file of an agent's spool")
    doctor.add_argument("--store", type=Path, help="folder of a map server's store")


def _add_query(nouns: Nouns, common: Parent, network: Parent) -> None:
    query = _noun(nouns, "query", "ask the map", [common, network])
    query.add_argument("--site", default="paper", help="name of the site (default %(default)s)")
    query.add_argument(
        "--after", type=int, default=0, help="wait until this journal row is merged; changes: those beyond this number"
    )
    query.add_argument("--layers", default="", help="layers, comma-separated; default all")
    asks = query.add_subparsers(metavar="QUERY", required=True, dest="ask")
    point = _ask(asks, "point", "the cell at a position, in metres")
    _add_place(point)
    _add_when(point)
    region = _ask(asks, "region", "a rectangle of cells, in metres")
    for side in ("west_m", "south_m", "east_m", "north_m"):
        region.add_argument(side, type=float)
    region.add_argument("--out", type=Path, help="write coordinates and layers as .npz")
    _add_when(region)
    history = _ask(asks, "history", "the cell at a position over time")
    _add_place(history)
    _add_times(
        history, ("from", "samples from this time on"), ("to", "samples up to this time; default the site's now")
    )
    history.add_argument("--span", type=positive, metavar="SECONDS", help="length of a span; default 5 minutes")
    _ask(asks, "machines", "what the map server knows of each machine")
    changes = _ask(asks, "changes", "where the ground changed, and when")
    changes.add_argument("--follow", action="store_true", help="go on with each change that is found, until stopped")
    _ask(asks, "info", "state of the map and its server")


def _ask(asks: Nouns, name: str, what: str) -> argparse.ArgumentParser:
    ask: argparse.ArgumentParser = asks.add_parser(
        name, help=what, description=what[0].upper() + what[1:] + ".", parents=[_quiet()]
    )
    return ask


def _add_trust(nouns: Nouns, common: Parent, network: Parent) -> None:
    trust = _noun(nouns, "trust", "use a machine's samples, whatever the map server finds", [common, network])
    trust.add_argument("--auto", action="store_true", help="leave it to the map server again")
    distrust = _noun(nouns, "distrust", "leave a machine's samples out of the map, earlier ones too", [common, network])
    distrust.add_argument("--reason", required=True, help="one line that is kept with the decision")
    for noun, trusted in ((trust, True), (distrust, False)):
        noun.set_defaults(module="sitegrid.commands.trust", trusted=trusted)
        noun.add_argument("machine", metavar="MACHINE")
        noun.add_argument("--site", default="paper", help="name of the site (default %(default)s)")
        noun.add_argument(
            "--wait",
            type=not_negative,
            default=30.0,
            help="seconds for the map to be folded again (default %(default)g)",
        )


def _quiet() -> argparse.ArgumentParser:
    """--json behind a word as well as before it: without a default, which would undo the one before."""
    quiet = argparse.ArgumentParser(add_help=False)
    quiet.add_argument("--json", action="store_true", default=argparse.SUPPRESS, help="print JSON for machines")
    return quiet


def _add_place(ask: argparse.ArgumentParser) -> None:
    ask.add_argument("x_m", type=float)
    ask.add_argument("y_m", type=float)


def _add_when(ask: argparse.ArgumentParser) -> None:
    _add_times(ask, ("as-of", "the map as of this time"), ("minus", "less the map as of this time"))


def _add_times(ask: argparse.ArgumentParser, *options: tuple[str, str]) -> None:
    for name, what in options:
        ask.add_argument(f"--{name}", dest=f"{name.replace('-', '_')}_time", type=parse_time, metavar="TIME", help=what)
    ask.epilog = f"TIME: {TIME_HELP}."
    # argparse knows no public way to say that -2h is a value as -2 is one, not an option
    ask._negative_number_matcher = re.compile(r"-\.?\d.*")  # noqa: SLF001


def _add_plot(nouns: Nouns, common: Parent, network: Parent) -> None:
    plot = _noun(nouns, "plot", "draw the map with OpenCV, once or live", [common, network])
    plot.add_argument("--site", default="paper", help="name of the site (default %(default)s)")
    plot.add_argument("--out", type=Path, default=Path("map.png"), help="picture to write (default %(default)s)")
    plot.add_argument("--bounds", type=float, nargs=4, metavar=("W", "S", "E", "N"), help="metres; default all")
    plot.add_argument("--truth", type=Path, help="true map of a simulation (truth_map.npz): draw the difference")
    plot.add_argument("--follow", action="store_true", help="redraw while machines drive, until stopped")
    plot.add_argument("--every", type=positive, default=1.0, help="seconds between two pictures (default %(default)s)")
    plot.add_argument("--pictures", type=int, default=0, help="with --follow: end after so many pictures")


def _add_eval(nouns: Nouns, common: Parent, _: Parent) -> None:
    evaluation = _noun(nouns, "eval", "run the experiments behind the project's figures", [common])
    asks = evaluation.add_subparsers(metavar="WHAT", required=True, dest="what")
    quiet = _quiet()
    physics = asks.add_parser(
        "physics", help="the simulator against mechanics, and its two worlds against each other", parents=[quiet]
    )
    _add_seeds(physics, 3)
    parity = asks.add_parser(
        "parity", help="the final poses that robot_localization's own tests assert, on its data", parents=[quiet]
    )
    parity.add_argument(
        "--data", type=Path, required=True, help="folder with the folders rl_test1_husky, rl_test2_jackal"
    )
    table = asks.add_parser("localisation", help="the paper's table on recordings of its site", parents=[quiet])
    _add_recorded(table, 1200.0)
    table.add_argument("--rows", choices=("all", "headline"), default="all", help="headline: 1 IMU with 1, 2, 3 GPS")
    table.add_argument("--plots", type=Path, help="folder to draw errors over time, tracks and the table into")
    ground = asks.add_parser("ground", help="rolling resistance and gradient of loaders at work", parents=[quiet])
    _add_recorded(ground, 600.0)
    ground.add_argument("--plots", type=Path, help="folder to draw estimates along the way, errors by place into")
    _add_merge(asks, quiet)
    log = asks.add_parser("log", help="a real log against fixes that were withheld, or its truth", parents=[quiet])
    log.add_argument("manifest", type=Path, metavar="MANIFEST", help="log.toml, or its folder")
    log.add_argument("--data", type=Path, help="folder with the CSV files, if not beside the manifest")
    log.add_argument(
        "--withhold",
        action="append",
        type=withhold,
        metavar="OFF/PERIOD",
        help="seconds without GPS of every so many, again for more (default none, 1/10, 10/30 and 30/60)",
    )
    log.add_argument("--gps", type=count, help="use the first receivers only")
    log.add_argument("--filter", choices=("ekf", "ukf"), default="ukf", help="default %(default)s")
    log.add_argument("--profile", choices=("default", "paper"), default="default", help="default %(default)s")


def _add_merge(asks: Nouns, quiet: Parent) -> None:
    merge = asks.add_parser("merge", help="the map of many machines' samples against others' merges", parents=[quiet])
    _add_kept(merge)
    merge.add_argument("--cases", default="", help="names, comma-separated; default all")
    merge.add_argument("--plots", type=Path, help="folder to draw the maps of the first seed and the table into")


def _add_fold(nouns: Nouns, common: Parent, _: Parent) -> None:
    fold = _noun(nouns, "fold", "fold archives again, with other parameters, into a new store", [common])
    fold.add_argument(
        "archives", type=Path, nargs="+", metavar="ARCHIVE", help="a Parquet file, a folder of them, or a store"
    )
    fold.add_argument("--out", type=Path, required=True, metavar="STORE", help="folder of the new store")
    fold.add_argument("--site-file", type=Path, help="the site, where the archives do not say it (site.toml)")
    fold.add_argument("--cell", type=positive, metavar="M", help="edge of a cell (default: that of the site)")
    fold.add_argument("--config", type=Path, help="options to fold and read with (config/server.toml)")
    fold.add_argument("--without", action="append", default=[], metavar="MACHINE", help="leave it out; again for more")
    for name, what in (("from", "samples stamped then or later"), ("until", "samples stamped before then")):
        help_text = f"{what} only; {STAMP_HELP}"
        fold.add_argument(f"--{name}", type=parse_stamp, dest=f"{name}_ns", metavar="T", help=help_text)


def _add_recorded(ask: argparse.ArgumentParser, seconds: float) -> None:
    """Options of what runs on recordings that are kept."""
    _add_kept(ask)
    ask.add_argument("--seconds", type=positive, default=seconds, help="of each recording (default %(default)g)")


def _add_kept(ask: argparse.ArgumentParser) -> None:
    """Options of what keeps its results by seed."""
    _add_seeds(ask, 12)
    ask.add_argument(
        "--out", type=Path, default=Path("eval-output"), help="folder of recordings and results (default %(default)s)"
    )
    ask.add_argument("--processes", type=count, help="how many at a time (default: one per core)")


def _add_seeds(ask: argparse.ArgumentParser, usual: int) -> None:
    ask.add_argument("--seeds", type=count, default=usual, help="how many (default %(default)s)")
    ask.add_argument("--first-seed", type=seed, default=0, help="the first of them (default %(default)s)")


def _noun(nouns: Nouns, name: str, what: str, parents: list[Parent]) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = nouns.add_parser(
        name, help=what, description=what[0].upper() + what[1:] + ".", parents=parents
    )
    parser.set_defaults(module=f"sitegrid.commands.{name}")
    return parser


def _fail(problem: str, as_json: bool) -> int:  # noqa: FBT001 - the user's own flag
    print(json.dumps({"error": problem}) if as_json else f"sitegrid: {problem}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(main())
