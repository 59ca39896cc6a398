"""Complete answers to queries that come in several replies."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np

from protocol.errors import MessageError, QueryError, Refusal
from protocol.queries import answer_codec
from protocol.queries.answers import ChangesAnswer, Piece, Region
from protocol.queries.map_tiles import TilesAnswer, TilesQuery
from protocol.queries.origin import Origin
from protocol.queries.request import MapQuery
from protocol.queries.requests import ChangesQuery, PieceQuery, RegionQuery
from sitegrid.follower_choice import Answered

REGION_ATTEMPTS = 3
Ask = Callable[[MapQuery[Any], Origin | None], Answered]  # one reply, from a certain process if given
T = TypeVar("T")
Progress = Callable[[int, int], object]  # pieces received, total


def whole_answer(query: MapQuery[T], ask: Ask, progress: Progress | None = None) -> T:
    """The complete answer; progress: called per piece of a large region with (received, total)."""
    answer: Any
    match query:
        case RegionQuery():
            answer = _region(query, ask, progress)
        case TilesQuery():
            answer = _tiles(query, ask)
        case ChangesQuery():
            answer = _changes(query, ask)
        case _:
            answer = _reply(query, ask)
    return cast(T, answer)


def _reply(query: MapQuery[T], ask: Ask) -> T:
    return query.decode(ask(query, None).data)


def _region(query: RegionQuery, ask: Ask, progress: Progress | None) -> Region:
    for _ in range(REGION_ATTEMPTS - 1):
        try:
            return joined(_pieces(query, ask), progress)
        except QueryError as error:
            if error.reason != Refusal.EXPIRED:  # else this version is no longer kept: start again
                raise
    return joined(_pieces(query, ask), progress)


def _pieces(query: RegionQuery, ask: Ask) -> Iterator[Region]:
    """The region or its pieces, all from one process."""
    answered = ask(query, None)
    yield (first := query.decode(answered.data))
    if first.piece:
        for number in range(1, first.piece.count):
            piece = PieceQuery(first.piece.cursor, number)
            yield piece.decode(ask(piece, answered.origin).data)


def _tiles(query: TilesQuery, ask: Ask) -> TilesAnswer:
    """Tiles from several replies; changes meanwhile may be in it, and differ again since its version."""
    first = answer = _reply(query, ask)
    tiles = list(first.tiles)
    while answer.next_place:
        answer = _reply(replace(query, place=answer.next_place), ask)
        if _goes_back(first, answer):
            return _tiles(replace(query, since=None, place=None), ask)
        tiles += answer.tiles
    return replace(first, tiles=tuple(tiles), next_place=None)


def _changes(query: ChangesQuery, ask: Ask) -> ChangesAnswer:
    answer = _reply(query, ask)
    if len(answer.changes) < answer_codec.MAX_CHANGES:
        return answer
    rest = _changes(ChangesQuery(answer.changes[-1].id), ask)
    return replace(rest, changes=answer.changes + rest.changes)


def _goes_back(first: TilesAnswer, answer: TilesAnswer) -> bool:
    """Whether the rest comes from another store, or from a process behind the first."""
    before, now = first.version, answer.version
    same = (before.store, first.whole) == (now.store, answer.whole)
    return not same or now.row < before.row or now.fact < before.fact


def joined(pieces: Iterable[Region], progress: Progress | None = None) -> Region:
    """Join pieces, each held only until copied; a region without `piece` is returned as is.

    MessageError if they do not fit together.
    """
    regions = iter(pieces)
    first = next(regions)
    if first.piece is None:
        return first
    whole, cells = first.piece, 0
    layers = {name: np.full((whole.rows, whole.columns), np.nan, np.float32) for name in first.layers}
    for number, (region, piece) in enumerate(_placed(first, regions)):
        if _identity(region) != _identity(first) or (piece.number, piece.count) != (number, whole.count):
            raise MessageError(Refusal.OUT_OF_RANGE, f"{piece} does not follow {whole}", field="piece")
        for name, values in region.layers.items():
            rows, columns = values.shape
            layers[name][piece.row : piece.row + rows, piece.column : piece.column + columns] = values
        cells += len(region.x_m) * len(region.y_m)
        if progress:
            progress(number + 1, whole.count)
    if cells != whole.columns * whole.rows:
        raise MessageError(Refusal.OUT_OF_RANGE, f"{cells} of {whole.columns} x {whole.rows} cells", field="piece")
    x_m, y_m = (
        axis[0] + np.arange(count) * first.cell_m
        for axis, count in ((first.x_m, whole.columns), (first.y_m, whole.rows))
    )
    return replace(first, x_m=x_m, y_m=y_m, layers=layers, piece=None)


def _placed(first: Region, others: Iterator[Region]) -> Iterator[tuple[Region, Piece]]:
    region: Region | None = first
    while region and region.piece:
        yield region, region.piece
        region = next(others, None)


def _identity(region: Region) -> tuple[object, ...]:
    """The common part of all pieces of a region."""
    piece = region.piece and (region.piece.cursor, region.piece.columns, region.piece.rows)
    return tuple(region.layers), region.cell_m, region.version, region.stamp_ns, piece
