"""`sitegrid eval`: the experiments behind the project's figures."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sitegrid.options.groups import add_action
from sitegrid.options.outputs import FOLDER
from sitegrid.options.values import count, positive, seed, withhold
from sitegrid.process.lifetime import note, plain, raise_interrupts, say, tell
from sitegrid.process.progress import Display

if TYPE_CHECKING:
    from evaluation.campaign.experiment import Runner

HELP = "run the accuracy experiments"
EXTRA = "eval"
Report = dict[str, Any]  # plain values by name; lists of rows are tables
MOST_COLUMNS = 24  # of a table; one with more is turned, its rows side by side
SCENARIOS = ("paper_site", "paper_site_driven", "haul_road_driven")  # of the paper's table; one machine drives alone
SHOWN = (list, dict)  # values of a row that a table for people has no room for


def add_options(parser: ArgumentParser) -> None:
    """Options of the command: those of each experiment."""
    what = parser.add_subparsers(metavar="WHAT", required=True, dest="what")
    physics = add_action(what, "physics", "compare the simulator with mechanics, and its two worlds with each other")
    parity = add_action(what, "parity", "compare final poses with those that robot_localization's tests expect")
    parity.add_argument(
        "--data", type=Path, required=True, help="folder with the folders rl_test1_husky, rl_test2_jackal"
    )
    table = add_action(what, "localisation", "repeat the paper's table on simulated recordings")
    ground = add_action(what, "ground", "measure the accuracy of rolling resistance and gradient of loaders at work")
    merge = add_action(what, "merge", "compare this map merge with other methods")
    for action, seeds in ((physics, 3), (table, 12), (ground, 12), (merge, 12)):
        action.add_argument("--seeds", type=count, default=seeds, help="number of seeds (default %(default)s)")
        action.add_argument("--first-seed", type=seed, default=0, help="first seed (default %(default)s)")
    out = "folder for recordings and results (default %(default)s)"
    for action, drawn in (
        (table, "errors over time, tracks and the table"),
        (ground, "estimates along the track, errors by place"),
        (merge, "the maps of the first seed and the table"),
    ):
        action.add_argument("--out", type=FOLDER, default="eval-output", help=out)
        action.add_argument("--processes", type=count, help="number of parallel processes (default: one per core)")
        action.add_argument("--plots", type=FOLDER, help=f"folder to draw {drawn} into")
    for action, seconds in ((table, 1200.0), (ground, 600.0)):
        length = "length of each recording in seconds (default %(default)g)"
        action.add_argument("--seconds", type=positive, default=seconds, help=length)
    scenario = "what is driven; in the last two the driver wanders and stops (default %(default)s)"
    table.add_argument("--scenario", choices=SCENARIOS, default=SCENARIOS[0], help=scenario)
    table.add_argument("--rows", choices=("all", "headline"), default="all", help="headline: 1 IMU with 1, 2, 3 GPS")
    merge.add_argument("--cases", default="", help="names, comma-separated; default all")
    _add_log(add_action(what, "log", "replay a real log and compare with withheld fixes or with its ground truth"))


def _add_log(log: ArgumentParser) -> None:
    log.add_argument("manifest", type=Path, metavar="MANIFEST", help="log.toml, or its folder")
    log.add_argument("--data", type=Path, help="folder with the CSV files, if not beside the manifest")
    off = "OFF seconds without GPS in every PERIOD seconds; may be repeated (default none, 1/10, 10/30, 30/60)"
    log.add_argument("--withhold", action="append", type=withhold, metavar="OFF/PERIOD", help=off)
    log.add_argument("--gps", type=count, help="number of GPS receivers to use")
    log.add_argument("--filter", choices=("ekf", "ukf"), default="ukf", help="filter (default %(default)s)")
    profile = "filter profile (default %(default)s)"
    log.add_argument("--profile", choices=("default", "paper"), default="default", help=profile)


def run(arguments: Namespace) -> int:
    """Run one evaluation and print its report."""
    evaluations = {
        "physics": _physics,
        "localisation": _localisation,
        "ground": _ground,
        "merge": _merge,
        "log": _log,
        "parity": _parity,
    }
    report = evaluations[arguments.what](arguments)
    if arguments.json:
        say(plain(report))
    else:
        tell("\n\n".join(_lines(report)))
    return 0


def _physics(arguments: Namespace) -> Report:
    from evaluation import physics

    return physics.run(_seeds(arguments), on_progress=note)


def _localisation(arguments: Namespace) -> Report:
    from evaluation.campaign.recordings import SETUPS
    from evaluation.positions import table
    from evaluation.positions.configurations import HEADLINE, SENSORS, configurations

    rows = configurations(HEADLINE if arguments.rows == "headline" else SENSORS)
    work = partial(
        table.run, seeds=_seeds(arguments), seconds=arguments.seconds, rows=rows, setup=SETUPS[arguments.scenario]
    )
    return _experiment(arguments, "machines drive, filters follow", work, "evaluation.positions.plots")


def _ground(arguments: Namespace) -> Report:
    from evaluation.ground import experiment

    work = partial(experiment.run, seeds=_seeds(arguments), seconds=arguments.seconds)
    return _experiment(arguments, "loaders work, estimators follow", work, "evaluation.ground.plots")


def _merge(arguments: Namespace) -> Report:
    from evaluation.maps import experiment
    from evaluation.maps.cases import select

    cases = select([name for name in arguments.cases.split(",") if name])
    work = partial(experiment.run, seeds=_seeds(arguments), cases=cases)
    return _experiment(arguments, "machines drive, their samples are merged", work, "evaluation.maps.plots")


def _experiment(arguments: Namespace, title: str, work: Callable[[Runner], tuple[Report, Any]], plots: str) -> Report:
    """Run an experiment with its progress shown, and draw its pictures where they are asked for."""
    from evaluation.campaign.experiment import Runner
    from evaluation.campaign.workers import cores

    raise_interrupts()  # the bar hides the cursor of the terminal
    with Display(title, headless=arguments.json) as display:
        runner = Runner(arguments.out, arguments.processes or cores(), display.show)
        report, outcomes = work(runner)
    if not arguments.json:
        note(f"recordings and results are in {arguments.out}")
    if arguments.plots:
        pictures = import_module(plots)  # imported here: only pictures need matplotlib
        report = {**report, "plots": list(map(str, pictures.draw(report, outcomes, runner, arguments.plots)))}
    return report


def _log(arguments: Namespace) -> Report:
    from evaluation.positions import real_logs
    from evaluation.positions.configurations import Configuration, select

    with real_logs.opened(arguments.manifest, arguments.data) as (log, truth):
        log = real_logs.refitted(log, select(log.machine, gps=arguments.gps))
        row = Configuration(arguments.filter, real_logs.receivers(log.machine), 1, arguments.profile)
        return real_logs.run(log, truth, row, arguments.withhold or real_logs.WITHHOLD, on_progress=note)


def _parity(arguments: Namespace) -> Report:
    from evaluation.positions import parity

    return {"rows": parity.run(arguments.data, on_progress=note)}


def _seeds(arguments: Namespace) -> range:
    return range(arguments.first_seed, arguments.first_seed + arguments.seeds)


def _lines(report: Report) -> list[str]:
    """For people: values on a line of their own, rows as tables."""
    from benchmarks.measure import table

    lines = []
    for name, value in report.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            shown = [k for k in value[0] if not any(isinstance(row[k], SHOWN) for row in value)]
            rows = [{k: row[k] for k in shown} for row in value]
            lines.append(table(_turned(rows) if len(rows[0]) > MOST_COLUMNS else rows))
        elif value not in ([], {}):
            lines.append(f"{name}: {value}")
    return lines


def _turned(rows: Sequence[Report]) -> list[Report]:
    """Rows as columns, under their first values."""
    named = {f"{next(iter(row.values()))} {list(row.values())[1]}": row for row in rows}
    return [{"": name, **{title: row[name] for title, row in named.items()}} for name in list(rows[0])[2:]]
