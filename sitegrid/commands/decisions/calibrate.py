"""`sitegrid calibrate`: calibrate all machines now, or decide one machine's corrections."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace

from protocol.errors import ConfigError
from protocol.queries.calibration import CalibrationAnswer
from sitegrid.answer_text import calibration_table
from sitegrid.client import Client, connect
from sitegrid.commands.decisions.trust import add_wait
from sitegrid.options.groups import add_network, add_site
from sitegrid.process.lifetime import plain, say, tell

HELP = "calibrate all machines now, or correct one by hand"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add_network(parser)
    add_site(parser)
    add = parser.add_argument
    add(
        "machine", metavar="MACHINE", nargs="?", default="", help="correct this machine by hand; default: calibrate all"
    )
    add("--zero", type=float, help="taken off its balance, added to its slopes ahead, in m/m")
    add("--scale", type=float, help="share of its drive force that is not there")
    add("--across", type=float, help="taken off its slopes to the left, in m/m")
    add("--auto", action="store_true", help="let the map server decide again")
    add("--reason", help="where the values are from, in one line, kept with the decision")
    add_wait(parser)


def run(arguments: Namespace) -> int:
    """Calibrate, wait for the map, print the calibration."""
    values = {name: getattr(arguments, name) for name in ("zero", "scale", "across")}
    given = [f"--{name}" for name, value in values.items() if value is not None] + ["--auto"] * arguments.auto
    if given and not arguments.machine:
        raise ConfigError(given[0], "is about one machine: name it")
    if arguments.machine and not given:
        raise ConfigError(arguments.machine, "give --zero, --scale, --across or --auto; without a machine all are done")
    if arguments.auto and len(given) > 1:
        raise ConfigError(given[0], "is a person's value, and --auto leaves it to the map server; give one of them")
    if len(given) > arguments.auto and not arguments.reason:
        raise ConfigError("--reason", "is missing: say where the values are from")
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        answer = _given(client, arguments, values)
    say(plain(answer)) if arguments.json else tell(*calibration_table(answer))
    return 0


def _given(client: Client, arguments: Namespace, values: dict[str, float | None]) -> CalibrationAnswer:
    machine, wait_s = arguments.machine, arguments.wait
    if arguments.auto:
        return client.calibrate_automatically(machine, wait_s=wait_s)
    if machine:
        return client.correct(machine, arguments.reason, **values, wait_s=wait_s)
    return client.calibrate(wait_s=wait_s)
