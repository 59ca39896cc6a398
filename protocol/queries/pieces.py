"""A region joined from its pieces."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from protocol.errors import MessageError, Refusal
from protocol.queries.answers import Piece, Region

Progress = Callable[[int, int], object]  # how many pieces of how many are here


def joined(pieces: Iterable[Region], progress: Progress | None = None) -> Region:
    """The region that pieces make up, each held only until it is copied; one without `piece` is a region.

    Raises MessageError where they do not fit together.
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
    """What is the same in all pieces of a region."""
    piece = region.piece and (region.piece.cursor, region.piece.columns, region.piece.rows)
    return tuple(region.layers), region.cell_m, region.version, region.stamp_ns, piece
