"""Options of the command line for the parameters of a query, and the query of what was given."""

from __future__ import annotations

import re
from argparse import ArgumentParser, BooleanOptionalAction, Namespace
from collections.abc import Callable, Container, Mapping
from typing import Any

from protocol.queries.parameters import ValueForm, text_of
from protocol.queries.request import MapQuery, Parameter, parameters_of
from protocol.queries.requests import parse_query
from sitegrid.options.values import site_time
from sitegrid.times import HELP

NUMBERS = {ValueForm.PLACE: 2, ValueForm.PLACES: "+", ValueForm.RECTANGLE: 4}  # of a value, each a word of its own
SIDES = ("W", "S", "E", "N")


def add_parameters(parser: ArgumentParser, query: type[MapQuery[Any]], without: Container[str] = ()) -> None:
    """An option for each parameter of a query, but those that the command adds by itself."""
    for one in parameters_of(query).values():
        if one.name not in without:
            _add(parser, one)
    if any(one.kind.form is ValueForm.STAMP for one in parameters_of(query).values()):
        parser.epilog = f"TIME: {HELP}."
    # argparse knows no public way to say that -2h is a value as -2 is one, not an option
    parser._negative_number_matcher = re.compile(r"-\.?\d.*")  # noqa: SLF001


def _add(parser: ArgumentParser, one: Parameter) -> None:
    option: dict[str, Any] = {"dest": dest(one.name), "help": one.help.replace("%", "%%")}
    form = one.kind.form
    if form is ValueForm.FLAG:
        option |= {"action": BooleanOptionalAction}
    elif form is ValueForm.STAMP:
        option |= {"type": site_time, "metavar": "TIME"}
    elif form in NUMBERS:
        option |= {"type": float, "nargs": NUMBERS[form], "metavar": SIDES if form is ValueForm.RECTANGLE else "M"}
    else:
        option |= {"metavar": "VALUE"}
    parser.add_argument(f"--{one.name.replace('_', '-')}", **option)


def dest(name: str) -> str:
    """Where argparse keeps what was given of a parameter."""
    return f"asked_{name}"


def given(query: type[MapQuery[Any]], arguments: Namespace, now_ns: Callable[[], int]) -> MapQuery[Any]:
    """The query that was asked for; QueryError says what is wrong with which parameter.

    now_ns: the site's now, for times that count back from it.
    """
    texts = {}
    for name, value in vars(arguments).items():
        if name.startswith(dest("")) and value is not None:
            one = parameters_of(query).get(parameter := name.removeprefix(dest("")))
            texts[parameter] = _text(one, value, now_ns) if one else str(value)
    return parse_query(query.name, texts)


def _text(one: Parameter, value: Any, now_ns: Callable[[], int]) -> str:
    match one.kind.form:
        case ValueForm.STAMP:
            return str(value.stamp(f"--{one.name.replace('_', '-')}", now_ns))
        case ValueForm.FLAG:
            return str(int(value))
        case ValueForm.LINE:
            return one.kind.write(value)
    return numbers(value) if isinstance(value, list) else str(value)


def numbers(values: list[float]) -> str:
    """Numbers as a parameter has them."""
    return ",".join(map(text_of, values))


def spread(places: Mapping[str, list[float] | float | None]) -> dict[str, Any]:
    """Places that a command takes by words of its own, as what argparse keeps of parameters."""
    return {dest(name): value for name, value in places.items() if value is not None}
