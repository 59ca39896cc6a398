"""`sitegrid query`: ask the map from the command line."""

from __future__ import annotations

import time
from argparse import SUPPRESS, ArgumentParser, Namespace
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from protocol.files import whole_file
from protocol.queries.answers import GroundChange, Region
from protocol.queries.request import MapQuery
from protocol.queries.requests import QUERIES, ChangesQuery, HistoryQuery, RegionQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from sitegrid.answer_text import AS_TEXT, Answer, change_line, record_text
from sitegrid.client import Client, connect
from sitegrid.options.groups import Subparsers, add_action, add_network, add_site, sentence
from sitegrid.options.parameters import add_parameters, dest, given, spread
from sitegrid.options.values import OutputFile
from sitegrid.process import streams
from sitegrid.process.lifetime import note, plain, say, stop_flag, tell, wait
from sitegrid.process.progress import EVERY_S
from sitegrid.whole_answers import Progress

HELP = "ask the map"
HISTORY_LAYERS = ("resistance", "confidence", "grade", "visits", "weight")  # default columns for people
# Positional words per query: their name in the usage, and their parts.
POSITION = ("x_m", "y_m")
WORDS: dict[str, tuple[str, tuple[str, ...] | str]] = {
    "point": ("position, in metres", POSITION),
    "why": ("position, in metres", POSITION),
    "history": ("position, in metres", POSITION),
    "points": ("positions, in metres", "X_M Y_M"),
    "region": ("west, south, east, north; or the corners x y x y x y ... of an outline", "M"),
    "route": ("places of the line, in metres", "X_M Y_M"),
    "way": ("from a place to another, in metres", ("from_x_m", "from_y_m", "to_x_m", "to_y_m")),
}
PLACED = ("x", "y", "places", "bounds", "polygon", "line", "from", "to")  # parameters from these words
FOR_PROGRAMS = ("piece", "tiles", "lanes")
FOLLOWERS = "followers that answer, and how far behind they are"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    _add_common(parser)
    queries = parser.add_subparsers(metavar="QUERY", required=True)
    for name, cls in QUERIES.items():
        if name not in FOR_PROGRAMS:
            _add_query(queries, cls)
    followers = add_action(queries, "followers", FOLLOWERS, sentence(FOLLOWERS))
    _add_common(followers, again=True)
    followers.set_defaults(ask=_ask_followers)


def _add_query(queries: Subparsers, cls: type[MapQuery[Any]]) -> None:
    query = add_action(queries, cls.name, cls.help, sentence(cls.help))
    _add_common(query, again=True)
    by_words = PLACED if cls.name in WORDS and cls.name != "history" else ("x", "y")
    add_parameters(query, cls, (*by_words, "after", "wait", "layers"))
    query.set_defaults(ask=partial(_ask, cls))
    if cls.name in WORDS:
        what, names = WORDS[cls.name]
        if isinstance(names, str):
            query.add_argument("numbers", type=float, nargs="+", metavar=names, help=what)
        else:
            for name in names:
                query.add_argument(name, type=float, nargs="?" if names == POSITION else None)
        if names == POSITION:
            for name, help_ in (
                ("--lat", "latitude [deg], with --lon in place of x_m and y_m"),
                ("--lon", "longitude"),
            ):
                query.add_argument(name, type=float, metavar="DEG", help=help_)
    if cls is RegionQuery:
        query.add_argument("--out", type=OutputFile((".npz",)), help="write coordinates and layers into this .npz file")
    if cls is ChangesQuery:
        query.add_argument(
            "--follow", action="store_true", help="print new changes as they are detected, until stopped"
        )


def _add_common(parser: ArgumentParser, *, again: bool = False) -> None:
    """Options before and after the query's name."""
    add_network(parser, again=again)
    add_site(parser, again=again)
    default = SUPPRESS if again else None
    after = "wait until this journal row is in the map; for changes: list those after this number"
    parser.add_argument("--after", dest=dest("after"), type=int, default=default, metavar="NUMBER", help=after)
    layers = "layers, comma-separated; default all"
    parser.add_argument("--layers", dest=dest("layers"), default=default, help=layers)


def run(arguments: Namespace) -> int:
    """Query once and print the answer; with --follow until stopped."""
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        if getattr(arguments, "follow", False):
            _follow_changes(client, arguments)
            return 0
        table, lines = arguments.ask(client, arguments)
    say(plain(table)) if arguments.json else tell(*lines)
    return 0


def _ask(cls: type[MapQuery[Any]], client: Client, arguments: Namespace) -> Answer:
    """Send the query."""
    vars(arguments).update(_placed(cls, arguments, client))
    if cls is HistoryQuery and not arguments.asked_layers and not arguments.json:
        arguments.asked_layers = ",".join(HISTORY_LAYERS)
    query = given(cls, arguments, lambda: client.info().stamp_ns)
    answer = client.ask(query, progress=_pieces_shown())
    show: Callable[..., Answer] = AS_TEXT.get(cls.name, record_text)
    table, lines = show(client, query, answer)
    return _written(answer, arguments.out, table, lines) if getattr(arguments, "out", None) else (table, lines)


def _placed(cls: type[MapQuery[Any]], arguments: Namespace, client: Client) -> dict[str, Any]:
    """Parameters from positional words."""
    if WORDS.get(cls.name, ("", ""))[1] == POSITION:
        if arguments.lat is not None and arguments.lon is not None:
            arguments.x_m, arguments.y_m = client.to_map(arguments.lat, arguments.lon)
        return spread({"x": arguments.x_m, "y": arguments.y_m})
    if cls is WayQuery:
        ends = {end: [getattr(arguments, f"{end}_{axis}_m") for axis in "xy"] for end in ("from", "to")}
        return spread(ends)
    numbers: list[float] = getattr(arguments, "numbers", [])
    if cls is RegionQuery:
        return spread({"bounds" if len(numbers) == 4 else "polygon": numbers})
    return spread({"line" if cls is RouteQuery else "places": numbers}) if numbers else {}


def _written(region: Region, out: Path, table: Any, lines: Iterable[str]) -> Answer:
    """Write a region to a file and report it."""
    arrays: dict[str, Any] = {"x_m": region.x_m, "y_m": region.y_m, **region.layers}
    with whole_file(out) as file:
        np.savez_compressed(file, **arrays)
    return {**table, "file": str(out)}, [*lines, f"written to {out}"]


def _pieces_shown() -> Progress:
    """Show a large region's progress on standard error."""
    next_s = time.monotonic() + EVERY_S

    def show(here: int, count: int) -> None:
        nonlocal next_s
        if time.monotonic() >= next_s:
            next_s = time.monotonic() + EVERY_S
            note(f"{here} of {count} pieces")

    return show


def _follow_changes(client: Client, arguments: Namespace) -> None:
    """Known changes, then new ones; listens first, so none is missed."""
    stop = stop_flag()

    def show(change: GroundChange) -> None:
        say(plain(change)) if arguments.json else tell(change_line(change))
        if not streams.is_open():
            stop.set()

    listener = client.on_change(show)
    for change in client.changes(arguments.asked_after or 0):
        show(change)
    wait(stop)
    listener.close()


def _ask_followers(client: Client, _: Namespace) -> Answer:
    followers = client.followers()
    return followers, [*map(str, followers)] or ["no follower answers"]
