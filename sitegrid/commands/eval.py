"""`sitegrid eval`: the experiments behind the project's figures."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from typing import Any

from benchmarks.measure import table
from sitegrid.process.lifetime import note, plain, say
from sitegrid.process.progress import Display

Tables = dict[str, Any]
MOST_COLUMNS = 24  # of a table; one with more is turned, its rows side by side
SHOWN = (list, dict)  # values of a row that a table for people has no room for


def run(arguments: Namespace) -> int:
    """Run one evaluation and print what it found."""
    asks = {
        "physics": _physics,
        "localisation": _localisation,
        "ground": _ground,
        "merge": _merge,
        "log": _log,
        "parity": _parity,
    }
    result = asks[arguments.what](arguments)
    if arguments.json:
        say(plain(result))
    else:
        print("\n\n".join(_lines(result)))
    return 0


def _physics(arguments: Namespace) -> Tables:
    from evaluation import physics

    return physics.run(_seeds(arguments), on_progress=note)


def _localisation(arguments: Namespace) -> Tables:
    from evaluation.campaign.workers import cores
    from evaluation.positions import table
    from evaluation.positions.configurations import HEADLINE, SENSORS, configurations

    plan = table.Plan(
        seeds=tuple(_seeds(arguments)),
        seconds=arguments.seconds,
        rows=tuple(configurations(HEADLINE if arguments.rows == "headline" else SENSORS)),
        cache=arguments.out,
        processes=arguments.processes or cores(),
    )
    with Display("machines drive, filters follow", headless=arguments.json) as display:
        result, outcomes = table.run(plan, display.show)
    if arguments.plots:
        from evaluation.positions import plots  # imported here: only pictures need matplotlib

        result["plots"] = [str(path) for path in plots.draw(result, outcomes, arguments.plots)]
    return result


def _ground(arguments: Namespace) -> Tables:
    from evaluation.campaign.workers import cores
    from evaluation.ground import experiment

    plan = experiment.Plan(
        seeds=tuple(_seeds(arguments)),
        seconds=arguments.seconds,
        cache=arguments.out,
        processes=arguments.processes or cores(),
    )
    with Display("loaders work, estimators follow", headless=arguments.json) as display:
        result, outcomes = experiment.run(plan, display.show)
    if arguments.plots:
        from evaluation.ground import plots  # imported here: only pictures need matplotlib

        result["plots"] = [str(path) for path in plots.draw(outcomes, arguments.plots)]
    return result


def _merge(arguments: Namespace) -> Tables:
    from evaluation.campaign.workers import cores
    from evaluation.maps import experiment
    from evaluation.maps.cases import select

    plan = experiment.Plan(
        seeds=tuple(_seeds(arguments)),
        cache=arguments.out,
        processes=arguments.processes or cores(),
        cases=select([name for name in arguments.cases.split(",") if name]),
    )
    with Display("machines drive, their samples are merged", headless=arguments.json) as display:
        result = experiment.run(plan, display.show)
    if arguments.plots:
        from evaluation.maps import plots  # imported here: only pictures need matplotlib

        result["plots"] = [str(path) for path in plots.draw(result, plan, arguments.plots)]
    return result


def _log(arguments: Namespace) -> Tables:
    from evaluation.positions import real_logs
    from evaluation.positions.configurations import Configuration, select

    with real_logs.opened(arguments.manifest, arguments.data) as log:
        machine = select(log.machine, gps=arguments.gps)
        row = Configuration(arguments.filter, real_logs.receivers(machine), 1, arguments.profile)
        return real_logs.run(log, machine, row, arguments.withhold or real_logs.WITHHOLD, on_progress=note)


def _parity(arguments: Namespace) -> Tables:
    from evaluation.positions import parity

    return parity.run(arguments.data, on_progress=note)


def _seeds(arguments: Namespace) -> range:
    return range(arguments.first_seed, arguments.first_seed + arguments.seeds)


def _lines(result: Tables) -> list[str]:
    """For people: values on a line of their own, rows as tables."""
    lines = []
    for name, value in result.items():
        if isinstance(value, list) and value and isinstance(value[0], dict):
            shown = [k for k in value[0] if not any(isinstance(row[k], SHOWN) for row in value)]
            rows = [{k: row[k] for k in shown} for row in value]
            lines.append(table(_turned(rows) if len(rows[0]) > MOST_COLUMNS else rows))
        elif value not in ([], {}):
            lines.append(f"{name}: {value}")
    return lines


def _turned(rows: Sequence[Tables]) -> list[Tables]:
    """Rows as columns, under their first values."""
    named = {f"{next(iter(row.values()))} {list(row.values())[1]}": row for row in rows}
    return [{"": name, **{title: row[name] for title, row in named.items()}} for name in list(rows[0])[2:]]
