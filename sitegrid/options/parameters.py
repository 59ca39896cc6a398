"""Command line options for query parameters, and the resulting query."""

from __future__ import annotations

import re
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Container, Mapping
from typing import Any

from protocol.queries.parameters import ValueForm, text_of
from protocol.queries.request import MapQuery, Parameter, parameters_of
from protocol.queries.requests import parse_query
from sitegrid.options.values import site_time
from sitegrid.times import HELP

NUMBERS = {ValueForm.PLACE: 2, ValueForm.PLACES: "+", ValueForm.RECTANGLE: 4}  # words per value
SIDES = ("W", "S", "E", "N")


def add_parameters(parser: ArgumentParser, query: type[MapQuery[Any]], without: Container[str] = ()) -> None:
    """Add an option per query parameter, except `without`."""
    for one in parameters_of(query).values():
        if one.name not in without:
            _add(parser, one)
    if any(one.kind.form is ValueForm.STAMP for one in parameters_of(query).values()):
        parser.epilog = f"TIME: {HELP}."
    # argparse cannot publicly learn that -2h is a value like -2
    parser._negative_number_matcher = re.compile(r"-\.?\d.*")  # noqa: SLF001


def _add(parser: ArgumentParser, one: Parameter) -> None:
    option: dict[str, Any] = {"dest": dest(one.name), "help": one.help.replace("%", "%%")}
    form = one.kind.form
    if form is ValueForm.STAMP:
        option |= {"type": site_time, "metavar": "TIME"}
    elif form in NUMBERS:
        option |= {"type": float, "nargs": NUMBERS[form], "metavar": SIDES if form is ValueForm.RECTANGLE else "M"}
    else:
        option |= {"metavar": "VALUE"}
    parser.add_argument(f"--{one.name.replace('_', '-')}", **option)


def dest(name: str) -> str:
    """Destination of a parameter in argparse."""
    return f"asked_{name}"


def given(query: type[MapQuery[Any]], arguments: Namespace, now_ns: Callable[[], int]) -> MapQuery[Any]:
    """The query from the options; QueryError names the wrong parameter.

    now_ns: the site's now, for relative times.
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
        case ValueForm.LINE:
            return one.kind.write(value)
    return numbers(value) if isinstance(value, list) else str(value)


def numbers(values: list[float]) -> str:
    """Numbers in a parameter's form."""
    return ",".join(map(text_of, values))


def spread(places: Mapping[str, list[float] | float | None]) -> dict[str, Any]:
    """Places from a command's own words, as argparse would keep parameters."""
    return {dest(name): value for name, value in places.items() if value is not None}
