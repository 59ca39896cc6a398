"""Map queries answered: the window's blocks are copied by the writer's thread, layers are derived here, outside it."""

from __future__ import annotations

from typing import Any

import numpy as np

from mapserver import layers
from mapserver.grid import chunks
from mapserver.store import Store
from mapserver.writer import Writer
from protocol.arrays import Floats32
from protocol.geometry import BLOCK_CELLS, Bounds, CellWindow
from protocol.queries import (
    InfoQuery,
    MapQuery,
    PointAnswer,
    PointQuery,
    Region,
    RegionQuery,
    check_size,
    encode_info,
    encode_point,
    encode_region,
    parse_query,
)
from protocol.site import SiteConfig


class Answers:
    """Answers the queries of one map, from any thread."""

    def __init__(self, writer: Writer, site: SiteConfig, config: layers.ReadConfig) -> None:
        self._writer = writer
        self._site = site
        self._config = config

    def answer(self, name: str, parameters: dict[str, str]) -> bytes:
        """Parse and answer one query; QueryError says what is wrong with it."""
        query = parse_query(name, parameters)
        self._writer.wait_merged(query.fresh.after, query.fresh.wait_s)
        return self._encode(query)

    def _encode(self, query: MapQuery) -> bytes:
        if isinstance(query, PointQuery):
            return encode_point(self.point(query))
        if isinstance(query, RegionQuery):
            return encode_region(self.region(query))
        assert isinstance(query, InfoQuery)
        return encode_info(self.info())

    def info(self) -> dict[str, Any]:
        """State of the map, with the names of its layers."""
        return {**self._writer.info(), "layers": list(layers.LAYERS)}

    def point(self, query: PointQuery) -> PointAnswer:
        """Layers of the cell that a position lies in."""
        x, y = query.x_m, query.y_m
        window = self._site.geometry.window(Bounds(x, y, np.nextafter(x, np.inf), np.nextafter(y, np.inf)))
        region = self._read(CellWindow(window.column, window.row, 1, 1), query.layers)
        values = {name: float(layer[0, 0]) for name, layer in region.layers.items()}
        return PointAnswer(float(region.x_m[0]), float(region.y_m[0]), values, region.merged, region.stamp_ns)

    def region(self, query: RegionQuery) -> Region:
        """Layers of all cells that a rectangle touches."""
        return self._read(self._site.geometry.window(query.bounds), query.layers)

    def _read(self, window: CellWindow, names: tuple[str, ...]) -> Region:
        check_size(window.columns, window.rows)
        names = layers.select(names)
        shape = (window.rows, window.columns)
        out: dict[str, Floats32] = {name: np.full(shape, np.nan, np.float32) for name in names}
        blocks, merged, stamp_ns = self._writer.read(lambda s: (s.grid.blocks_in(window), s.merged, s.newest_ns))
        for some in chunks(blocks):
            evidence = self._writer.read(_evidence_of(some))
            for name, values in layers.read(evidence, names, self._config).items():
                _place(out[name], window, some, values)
        geometry = self._site.geometry
        return Region(
            x_m=geometry.centres(window.column, window.columns),
            y_m=geometry.centres(window.row, window.rows),
            cell_m=self._site.cell_m,
            layers=out,
            merged=merged,
            stamp_ns=stamp_ns,
        )


def _evidence_of(blocks: list[tuple[int, int]]) -> Any:
    def copy(store: Store) -> Any:
        return store.grid.evidence(blocks)

    return copy


def _place(out: Floats32, window: CellWindow, blocks: list[tuple[int, int]], values: Floats32) -> None:
    """Copy block values (blocks, 256) into the window."""
    n = BLOCK_CELLS
    for (x, y), block in zip(blocks, values.reshape(-1, n, n), strict=True):
        column, row = x * n - window.column, y * n - window.row
        left, top = max(0, -column), max(0, -row)
        right, bottom = min(n, window.columns - column), min(n, window.rows - row)
        out[row + top : row + bottom, column + left : column + right] = block[top:bottom, left:right]
