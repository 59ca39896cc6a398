"""`sitegrid eval`: the experiments behind the project's figures."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from sitegrid.options.groups import Subparsers, add_action
from sitegrid.options.values import count, positive, seed, withhold
from sitegrid.process.lifetime import note, plain, say
from sitegrid.process.progress import Display

HELP = "run the accuracy experiments"
Report = dict[str, Any]  # plain values by name; lists of rows are tables
MOST_COLUMNS = 24  # of a table; one with more is turned, its rows side by side
SHOWN = (list, dict)  # values of a row that a table for people has no room for


def add_options(parser: ArgumentParser) -> None:
    """Options of the command: those of each experiment."""
    experiments = parser.add_subparsers(metavar="WHAT", required=True)
    physics = _add(experiments, _physics, "compare the simulator with mechanics, and its two worlds with each other")
    _add_seeds(physics, 3)
    parity = _add(experiments, _parity, "compare final poses with those that robot_localization's tests expect")
    folders = "folder with the folders rl_test1_husky, rl_test2_jackal"
    parity.add_argument("--data", type=Path, required=True, help=folders)
    table = _add(experiments, _localisation, "repeat the paper's table on simulated recordings")
    _add_kept(table, "errors over time, tracks and the table", 1200.0)
    table.add_argument("--rows", choices=("all", "headline"), default="all", help="headline: 1 IMU with 1, 2, 3 GPS")
    ground = _add(experiments, _ground, "measure the accuracy of rolling resistance and gradient of loaders at work")
    _add_kept(ground, "estimates along the track, errors by place", 600.0)
    merge = _add(experiments, _merge, "compare this map merge with other methods")
    _add_kept(merge, "the maps of the first seed and the table")
    merge.add_argument("--cases", default="", help="names, comma-separated; default all")
    _add_log(_add(experiments, _log, "replay a real log and compare with withheld fixes or with its ground truth"))


def _add(experiments: Subparsers, evaluate: Callable[[Namespace], Report], summary: str) -> ArgumentParser:
    parser = add_action(experiments, evaluate.__name__.removeprefix("_"), summary)
    parser.set_defaults(evaluate=evaluate)
    return parser


def _add_log(parser: ArgumentParser) -> None:
    add = parser.add_argument
    add("manifest", type=Path, metavar="MANIFEST", help="log.toml, or its folder")
    add("--data", type=Path, help="folder with the CSV files, if not beside the manifest")
    pattern = "OFF seconds without GPS in every PERIOD seconds; may be repeated (default none, 1/10, 10/30, 30/60)"
    add("--withhold", action="append", type=withhold, metavar="OFF/PERIOD", help=pattern)
    add("--gps", type=count, help="number of GPS receivers to use")
    add("--filter", choices=("ekf", "ukf"), default="ukf", help="filter (default %(default)s)")
    add("--profile", choices=("default", "paper"), default="default", help="filter profile (default %(default)s)")


def _add_kept(parser: ArgumentParser, drawn: str, seconds: float = 0) -> None:
    """Options of what keeps its results by seed. seconds: of each recording, where their length can be chosen."""
    _add_seeds(parser, 12)
    add = parser.add_argument
    if seconds:
        length = "length of each recording in seconds (default %(default)g)"
        add("--seconds", type=positive, default=seconds, help=length)
    kept = "folder for recordings and results (default %(default)s)"
    add("--out", type=Path, default=Path("eval-output"), help=kept)
    add("--processes", type=count, help="number of parallel processes (default: one per core)")
    add("--plots", type=Path, help=f"folder to draw {drawn} into")


def _add_seeds(parser: ArgumentParser, usual: int) -> None:
    parser.add_argument("--seeds", type=count, default=usual, help="number of seeds (default %(default)s)")
    parser.add_argument("--first-seed", type=seed, default=0, help="first seed (default %(default)s)")


def run(arguments: Namespace) -> int:
    """Run one evaluation and print its report."""
    report = arguments.evaluate(arguments)
    say(plain(report)) if arguments.json else print("\n\n".join(_lines(report)))
    return 0


def _physics(arguments: Namespace) -> Report:
    from evaluation import physics

    return physics.run(_seeds(arguments), on_progress=note)


def _localisation(arguments: Namespace) -> Report:
    from evaluation.positions import table
    from evaluation.positions.configurations import HEADLINE, SENSORS, configurations

    rows = configurations(HEADLINE if arguments.rows == "headline" else SENSORS)
    work = partial(table.run, seeds=_seeds(arguments), seconds=arguments.seconds, rows=rows)
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


def _experiment(arguments: Namespace, title: str, work: Callable[..., tuple[Any, Any]], plots: str) -> Report:
    """Run an experiment with its progress shown, and draw its pictures where they are asked for. work: of a Runner."""
    from evaluation.campaign.experiment import Runner
    from evaluation.campaign.workers import cores

    with Display(title, headless=arguments.json) as display:
        runner = Runner(arguments.out, arguments.processes or cores(), display.show)
        report, outcomes = work(runner)
    plain_report = asdict(report)
    if arguments.plots:
        pictures = import_module(plots)  # imported here: only pictures need matplotlib
        plain_report["plots"] = list(map(str, pictures.draw(report, outcomes, runner, arguments.plots)))
    return plain_report


def _log(arguments: Namespace) -> Report:
    from evaluation.positions import real_logs
    from evaluation.positions.configurations import Configuration, select

    with real_logs.opened(arguments.manifest, arguments.data) as log:
        machine = select(log.machine, gps=arguments.gps)
        row = Configuration(arguments.filter, real_logs.receivers(machine), 1, arguments.profile)
        return asdict(real_logs.run(log, machine, row, arguments.withhold or real_logs.WITHHOLD, on_progress=note))


def _parity(arguments: Namespace) -> Report:
    from evaluation.positions import parity

    return {"rows": [asdict(row) for row in parity.run(arguments.data, on_progress=note)]}


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
