"""The experiments behind the project's figures.

It is one module because experiments share options, and each of them adds only a few lines.
"""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from protocol.errors import ConfigError
from sitegrid.options.groups import add_action
from sitegrid.options.outputs import FOLDER, OutputFile
from sitegrid.options.values import count, positive, seed, shares
from sitegrid.process.lifetime import note, plain, raise_interrupts, say, tell
from sitegrid.process.progress import Display
from sitegrid.process.tables import lines

if TYPE_CHECKING:
    from lab.campaign.experiment import Runner

HELP = "run the accuracy experiments"
EXTRA = "eval"
Report = dict[str, Any]  # plain values by name; lists of rows are tables
DEFAULT_SEEDS, DEFAULT_S = 12, 1200.0  # of experiments on positions
COOPERATION_S = 1200.0  # of a lone machine, which drives the tours of all
SCENARIOS = ("paper_site", "paper_site_driven", "haul_road_driven")  # of the paper's table; one machine drives alone


def add_options(parser: ArgumentParser) -> None:
    """Options of the command: those of each experiment."""
    what = parser.add_subparsers(metavar="WHAT", required=True, dest="what")
    physics = add_action(what, "physics", "compare the simulator with mechanics, and its two worlds with each other")
    parity = add_action(what, "parity", "compare final poses with those that robot_localization's tests expect")
    parity.add_argument(
        "--data", type=Path, required=True, help="folder with the folders rl_test1_husky, rl_test2_jackal"
    )
    table = add_action(what, "localisation", "repeat the paper's table on simulated recordings")
    paper = add_action(
        what, "paper", "repeat the paper's tables and maps, and what this project makes of the same drives"
    )
    blackout = add_action(what, "blackout", "measure positions without GPS: blackouts, jumps afterwards, starts alone")
    budget = add_action(what, "budget", "show what each kind of error costs, by the truth in its place")
    ground = add_action(what, "ground", "measure the accuracy of rolling resistance and gradient of loaders at work")
    base = add_action(what, "base", "measure what a base station brings, also one that fails")
    merge = add_action(what, "merge", "compare this map merge with other methods")
    lag = add_action(what, "lag", "compare the maps of four loaders at work with and without the smoother's lag")
    fleet = add_action(
        what, "fleet", "measure what calibration of machines by each other and by the ground gives the map"
    )
    roads = add_action(what, "roads", "measure roads, traffic, losses and repairs on random patches of soil")
    routes = add_action(what, "routes", "compare routes with what machines spent, and ways with a finer search")
    cooperation = add_action(what, "cooperation", "measure what machines gain that draw one map, over real links")
    for action in (table, paper, blackout, budget, ground, base, merge, lag, fleet, roads, routes, cooperation):
        action.add_argument("--seeds", type=count, default=DEFAULT_SEEDS, help="number of seeds (default %(default)s)")
    physics.add_argument("--seeds", type=count, default=3, help="number of seeds (default %(default)s)")
    for action in (
        physics,
        table,
        paper,
        blackout,
        budget,
        ground,
        base,
        merge,
        lag,
        fleet,
        roads,
        routes,
        cooperation,
    ):
        action.add_argument("--first-seed", type=seed, default=0, help="first seed (default %(default)s)")
    out = "folder for recordings and results (default %(default)s)"
    for action in (table, paper, blackout, budget, ground, base, merge, lag, fleet, roads, routes, cooperation):
        action.add_argument("--out", type=FOLDER, default="eval-output", help=out)
        action.add_argument("--processes", type=count, help="number of parallel processes (default: one per core)")
    for action, drawn in (
        (table, "errors over time, tracks and the table"),
        (paper, "the maps, their wrong cells, tracks and errors of the first seed, and how sure maps are"),
        (blackout, "errors over the time without GPS"),
        (ground, "estimates along the track, errors by place"),
        (merge, "the maps of the first seed and the table"),
        (fleet, "the maps of the first seed before and after, and the table"),
        (cooperation, "what is known over time, by number of machines and by link"),
    ):
        action.add_argument("--plots", type=FOLDER, help=f"folder to draw {drawn} into")
    for action, seconds in (
        (table, DEFAULT_S),
        (paper, DEFAULT_S),
        (blackout, DEFAULT_S),
        (budget, DEFAULT_S),
        (ground, 600.0),
        (base, DEFAULT_S),
        (lag, 900.0),
        (fleet, 900.0),
        (roads, 900.0),
        (routes, 900.0),
        (cooperation, COOPERATION_S),
    ):
        length = "length of each recording in seconds (default %(default)g)"
        action.add_argument("--seconds", type=positive, default=seconds, help=length)
    scenario = "what is driven; in the last two the driver wanders and stops (default %(default)s)"
    for action in (table, blackout, budget):
        action.add_argument("--scenario", choices=SCENARIOS, default=SCENARIOS[0], help=scenario)
    table.add_argument("--rows", choices=("all", "headline"), default="all", help="headline: 1 IMU with 1, 2, 3 GPS")
    shared = "shares of slow GPS errors that the receivers have in common, comma-separated (default: as recorded)"
    table.add_argument("--shares", type=shares, default=(None,), help=shared)
    judged = "compare the EKF of the profile default with the batch optimum of the same runs, by GTSAM (extra oracle)"
    table.add_argument("--oracle", action="store_true", help=judged)
    tensor = (
        "file to write the map to that the paper plots, with the first seed: 2 x m x n x 3, x, y and value of each cell"
    )
    paper.add_argument("--tensor", type=OutputFile((".npy",)), metavar="FILE", help=tensor)
    tables = "positions: Tables 1 and 2 alone; maps: Table 3, and all else that is of maps (default %(default)s)"
    paper.add_argument("--tables", choices=("all", "positions", "maps"), default="all", help=tables)
    quick = "short drives of its own without PyBullet, and few rows: to see that all works"
    for action in (paper, cooperation):
        action.add_argument("--quick", action="store_true", help=quick)
    for action in (merge, roads, routes):
        action.add_argument("--cases", default="", help="names, comma-separated; default all")


def run(arguments: Namespace) -> int:
    """Run one evaluation and print its report."""
    from lab.campaign.provenance import made_by

    evaluations = {
        "physics": _physics,
        "localisation": _localisation,
        "paper": _paper,
        "blackout": _blackout,
        "budget": _budget,
        "ground": _ground,
        "base": _base,
        "merge": _merge,
        "lag": _lag,
        "fleet": _fleet,
        "roads": _roads,
        "routes": _routes,
        "cooperation": _cooperation,
        "parity": _parity,
    }
    report = evaluations[arguments.what](arguments)
    if arguments.json:
        say(plain({"made": made_by(arguments.words), **report}))
    else:
        tell("\n\n".join(lines(plain(report))))
    return 0


def _physics(arguments: Namespace) -> Report:
    from lab import physics

    return physics.run(_seeds(arguments), on_progress=note)


def _localisation(arguments: Namespace) -> Report:
    from lab.campaign.recordings import SETUPS
    from lab.positions import table
    from lab.positions.configurations import HEADLINE, SENSORS, configurations

    rows = configurations(HEADLINE if arguments.rows == "headline" else SENSORS, arguments.shares)
    work = partial(
        table.run, seeds=_seeds(arguments), seconds=arguments.seconds, rows=rows, setup=SETUPS[arguments.scenario]
    )
    judged = _with_oracle(work) if arguments.oracle else work
    return _experiment(arguments, "machines drive, filters follow", judged, "lab.positions.plots")


def _paper(arguments: Namespace) -> Report:
    from lab.paper import experiment
    from lab.paper.drives import QUICK, Plan
    from lab.paper.report import readable

    if arguments.tables == "positions" and (arguments.plots or arguments.tensor):
        raise ConfigError("--tables positions", "makes no maps to draw or to write: leave out --plots and --tensor")
    if arguments.tables != "all" and arguments.quick:
        raise ConfigError("--quick", "has tables of its own: leave out --tables")
    plan = Plan(_seeds(arguments), arguments.seconds)
    if _is_quick(arguments, DEFAULT_S):
        plan = QUICK
    elif arguments.tables == "positions":
        plan = replace(plan, sources=())
    elif arguments.tables == "maps":
        plan = replace(plan, positions=())

    def work(runner: Runner) -> tuple[Report, Any]:
        report, outcomes = experiment.run(runner, plan)
        if arguments.tensor:
            experiment.write_map(outcomes, runner, arguments.tensor)
        return report, outcomes

    report = _experiment(arguments, "machines drive, and plot what they drive on", work, "lab.paper.plots")
    return report if arguments.json else readable(report)


def _with_oracle(table: Callable[[Runner], tuple[Report, Any]]) -> Callable[[Runner], tuple[Report, Any]]:
    """The same experiment, and its EKF judged by the batch optimum."""
    from lab.positions import oracle

    oracle.require()

    def work(runner: Runner) -> tuple[Report, Any]:
        report, outcomes = table(runner)
        return {**report, "oracle": oracle.run(runner, outcomes)}, outcomes

    return work


def _blackout(arguments: Namespace) -> Report:
    from lab.campaign.recordings import SETUPS
    from lab.outages import blackouts

    setup = SETUPS[arguments.scenario]
    work = partial(blackouts.run, seeds=_seeds(arguments), seconds=arguments.seconds, setup=setup)
    return _experiment(arguments, "machines drive, and lose GPS", work, "lab.outages.plots")


def _budget(arguments: Namespace) -> Report:
    from lab.campaign.recordings import SETUPS
    from lab.positions import budget

    setup = SETUPS[arguments.scenario]
    work = partial(budget.run, seeds=_seeds(arguments), seconds=arguments.seconds, setup=setup)
    return _experiment(arguments, "machines drive, filters are given the truth", work)


def _ground(arguments: Namespace) -> Report:
    from lab.ground import experiment

    work = partial(experiment.run, seeds=_seeds(arguments), seconds=arguments.seconds)
    return _experiment(arguments, "loaders work, estimators follow", work, "lab.ground.plots")


def _base(arguments: Namespace) -> Report:
    from lab.positions import base_station

    work = partial(base_station.run, seeds=_seeds(arguments), seconds=arguments.seconds)
    return _experiment(arguments, "machines drive beside a base station", work)


def _merge(arguments: Namespace) -> Report:
    from lab.maps import experiment
    from lab.maps.cases import select

    cases = select([name for name in arguments.cases.split(",") if name])
    work = partial(experiment.run, seeds=_seeds(arguments), cases=cases)
    return _experiment(arguments, "machines drive, their samples are merged", work, "lab.maps.plots")


def _lag(arguments: Namespace) -> Report:
    from lab.ground import lag

    work = partial(lag.run, seeds=_seeds(arguments), seconds=arguments.seconds)
    return _experiment(arguments, "loaders work, their samples are smoothed and merged", work)


def _fleet(arguments: Namespace) -> Report:
    from lab.fleet import experiment

    work = partial(experiment.run, seeds=_seeds(arguments), seconds=arguments.seconds)
    return _experiment(arguments, "machines drive, and are calibrated by the ground", work, "lab.fleet.plots")


def _roads(arguments: Namespace) -> Report:
    from lab.roads import experiment

    cases = experiment.select([name for name in arguments.cases.split(",") if name])
    work = partial(experiment.run, seeds=_seeds(arguments), seconds=arguments.seconds, cases=cases)
    return _experiment(arguments, "machines drive on patches of soil, their samples show roads", work)


def _routes(arguments: Namespace) -> Report:
    from lab.routes import experiment

    cases = experiment.select([name for name in arguments.cases.split(",") if name])
    work = partial(experiment.run, seeds=_seeds(arguments), seconds=arguments.seconds, cases=cases)
    return _experiment(arguments, "machines drive on patches of soil, their samples price routes", work)


def _cooperation(arguments: Namespace) -> Report:
    from lab.cooperation import experiment
    from lab.cooperation.experiment import QUICK, Plan

    quick = _is_quick(arguments, COOPERATION_S)
    plan = QUICK if quick else Plan.full(_seeds(arguments), arguments.seconds)
    work = partial(experiment.run, plan=plan)
    return _experiment(arguments, "machines drive, and draw one map", work, "lab.cooperation.plots")


def _is_quick(arguments: Namespace, seconds: float) -> bool:
    """Whether the quick version is asked for; ConfigError where it is, and drives of another length or other seeds."""
    if arguments.quick and (_seeds(arguments), arguments.seconds) != (range(DEFAULT_SEEDS), seconds):
        raise ConfigError("--quick", "has a drive of its own: leave out --seeds, --first-seed and --seconds")
    return bool(arguments.quick)


def _experiment(
    arguments: Namespace, title: str, work: Callable[[Runner], tuple[Report, Any]], plots: str = ""
) -> Report:
    """Run an experiment with its progress shown, and draw its pictures, if it has any and they are asked for."""
    from lab.campaign.experiment import Runner
    from lab.campaign.workers import cores

    raise_interrupts()  # the bar hides the cursor of the terminal
    with Display(title, headless=arguments.json, kept=arguments.out) as display:
        runner = Runner(arguments.out, arguments.processes or cores(), display.show)
        report, outcomes = work(runner)
    if not arguments.json:
        note(f"recordings and results are in {arguments.out}")
    if plots and arguments.plots:
        pictures = import_module(plots)  # imported here: only pictures need matplotlib
        report = {**report, "plots": list(map(str, pictures.draw(report, outcomes, runner, arguments.plots)))}
    return report


def _parity(arguments: Namespace) -> Report:
    from lab.positions import parity

    return {"rows": parity.run(arguments.data, on_progress=note)}


def _seeds(arguments: Namespace) -> range:
    return range(arguments.first_seed, arguments.first_seed + arguments.seeds)
