"""A region joined from its tiles."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from protocol.errors import MessageError, Refusal
from protocol.queries.answers import Region, Tile

Progress = Callable[[int, int], object]  # how many tiles of how many are here


def joined(tiles: Iterable[Region], progress: Progress | None = None) -> Region:
    """The region that tiles make up, each held only until it is copied; one without `tile` is a region.

    Raises MessageError where they do not fit together.
    """
    regions = iter(tiles)
    first = next(regions)
    if first.tile is None:
        return first
    whole, cells = first.tile, 0
    layers = {name: np.full((whole.rows, whole.columns), np.nan, np.float32) for name in first.layers}
    for number, (region, tile) in enumerate(_placed(first, regions)):
        if _identity(region) != _identity(first) or (tile.number, tile.count) != (number, whole.count):
            raise MessageError(Refusal.OUT_OF_RANGE, f"{tile} does not follow {whole}", field="tile")
        for name, values in region.layers.items():
            rows, columns = values.shape
            layers[name][tile.row : tile.row + rows, tile.column : tile.column + columns] = values
        cells += len(region.x_m) * len(region.y_m)
        if progress:
            progress(number + 1, whole.count)
    if cells != whole.columns * whole.rows:
        raise MessageError(Refusal.OUT_OF_RANGE, f"{cells} of {whole.columns} x {whole.rows} cells", field="tile")
    x_m, y_m = (
        axis[0] + np.arange(count) * first.cell_m
        for axis, count in ((first.x_m, whole.columns), (first.y_m, whole.rows))
    )
    return replace(first, x_m=x_m, y_m=y_m, layers=layers, tile=None)


def _placed(first: Region, others: Iterator[Region]) -> Iterator[tuple[Region, Tile]]:
    region: Region | None = first
    while region and region.tile:
        yield region, region.tile
        region = next(others, None)


def _identity(region: Region) -> tuple[object, ...]:
    """What is the same in all tiles of a region."""
    tile = region.tile and (region.tile.cursor, region.tile.columns, region.tile.rows)
    return tuple(region.layers), region.cell_m, region.version, region.stamp_ns, tile
