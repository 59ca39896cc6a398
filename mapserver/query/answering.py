"""Map queries and commands answered: pages come from the writer's thread, layers are derived here, outside it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mapserver.follower.follower import Follower
from mapserver.ingest.store import JOURNAL_FILE
from mapserver.ingest.writer import Writer
from mapserver.journal.history import SpanEvidence
from mapserver.journal.rows import Selection
from mapserver.layers import cell_layers
from mapserver.layers.gap_filling import AREA_LAYERS
from mapserver.query.views import PastMaps, View, cropped, read_cells, view_now, widened
from protocol.errors import QueryError, Refusal
from protocol.queries import answer_codec as codec
from protocol.queries import requests
from protocol.queries.answers import HistoryAnswer, HistorySpan, MapVersion, PointAnswer, Region
from protocol.queries.commands import TrustCommand, parse_command
from protocol.queries.requests import MAX_SPANS, HistoryQuery, MapQuery, PointQuery, RegionQuery, When
from protocol.site.geometry import Bounds, CellWindow

WITHOUT_DIFFERENCE = ("heading",)  # axes: half a turn more is the same one


class Answers:
    """Answers the queries of one map, from any thread."""

    def __init__(self, writer: Writer, follower: Follower) -> None:
        self._writer, self._follower = writer, follower
        self._site, self._config = writer.site, writer.config
        self._past = PastMaps(writer.folder / JOURNAL_FILE, self._site.cell_m, self._config)

    def answer(self, name: str, parameters: Mapping[str, str]) -> bytes:
        """Parse and answer one query; QueryError says what is wrong with it."""
        query = requests.parse_query(name, parameters)
        self._writer.wait_merged(query.fresh.after, query.fresh.wait_s)
        return self._encode(query)

    def obey(self, name: str, parameters: Mapping[str, str]) -> bytes:
        """Parse and carry out one command; QueryError says what is wrong with it."""
        return codec.encode_machine(self.trust(parse_command(name, parameters)))

    def _encode(self, query: MapQuery) -> bytes:
        match query:
            case PointQuery():
                return codec.encode_point(self.point(query))
            case RegionQuery():
                return codec.encode_region(self.region(query))
            case HistoryQuery():
                return codec.encode_history(self.history(query))
            case requests.MachinesQuery():
                return codec.encode_machines(self._follower.machines(), self._version())
            case requests.ChangesQuery():
                return codec.encode_changes(self._follower.changes(query.after), self._version())
        return codec.encode_info(self.info())

    def info(self) -> dict[str, Any]:
        """State of the map, with the names of its layers."""
        return {**self._writer.info(), "layers": [*cell_layers.LAYERS, *AREA_LAYERS]}

    def point(self, query: PointQuery) -> PointAnswer:
        """Layers of the cell that a position lies in."""
        region = self._read(self._cell(query.x_m, query.y_m), query.layers, query.when)
        values = {name: float(layer[0, 0]) for name, layer in region.layers.items()}
        return PointAnswer(float(region.x_m[0]), float(region.y_m[0]), values, region.version, region.stamp_ns)

    def region(self, query: RegionQuery) -> Region:
        """Layers of all cells that a rectangle touches."""
        return self._read(self._site.geometry.window(query.bounds), query.layers, query.when)

    def history(self, query: HistoryQuery) -> HistoryAnswer:
        """Layers of the cell that a position lies in, span by span."""
        names = _of_cells(query.layers)
        now_ns, fact = self._writer.run(lambda store: (store.newest_ns, store.fact))
        span_s = query.span_s or self._config.fold.bucket_s
        from_ns, to_ns = _time_of(query, now_ns, span_s)
        cell = self._cell(query.x_m, query.y_m)
        selection = Selection(from_ns, to_ns, without=self._follower.excluded())
        moments, merged = self._past.moments((cell.column, cell.row), selection, span_s)
        x_m, y_m = (float(self._site.geometry.centres(index, 1)[0]) for index in (cell.column, cell.row))
        version = MapVersion(self._writer.store_id, merged, fact)
        return HistoryAnswer(x_m, y_m, tuple(self._span(moment, names) for moment in moments), version, now_ns)

    def trust(self, command: TrustCommand) -> dict[str, Any]:
        """What is known of the machine once the command counts, and the version of the map that it counts in."""
        row = self._follower.trust(command.machine, command.trusted, command.reason, command.wait_s)
        version = self._version()
        return {**row, "store": version.store, "merged": version.row, "fact": version.fact}

    def _version(self) -> MapVersion:
        return self._writer.run(lambda store: store.version)

    def _cell(self, x_m: float, y_m: float) -> CellWindow:
        window = self._site.geometry.window(Bounds(x_m, y_m, np.nextafter(x_m, np.inf), np.nextafter(y_m, np.inf)))
        return CellWindow(window.column, window.row, 1, 1)

    def _read(self, window: CellWindow, names: tuple[str, ...], when: When) -> Region:
        requests.check_size(window.columns, window.rows)
        if when.minus_ns is None:
            return self._map(window, cell_layers.select(names), when.as_of_ns)
        names = _with_difference(names)
        newer, older = (self._map(window, names, as_of_ns) for as_of_ns in (when.as_of_ns, when.minus_ns))
        differences = {name: newer[name] - older[name] for name in names}
        version = replace(newer.version, row=min(newer.merged, older.merged))
        return replace(newer, layers=differences, version=version)

    def _map(self, window: CellWindow, names: tuple[str, ...], as_of_ns: int | None) -> Region:
        wide = widened(window, cell_layers.margin_cells(names, self._site.cell_m, self._config.read))
        view = self._view(wide, as_of_ns)
        values = read_cells(view, wide, cell_layers.required(names), self._site.cell_m, self._config)
        areas = cell_layers.derive_area(names, values, self._site.cell_m, self._config.read)
        geometry = self._site.geometry
        return Region(
            x_m=geometry.centres(window.column, window.columns),
            y_m=geometry.centres(window.row, window.rows),
            cell_m=self._site.cell_m,
            layers={name: cropped(layer, wide, window) for name, layer in areas.items()},
            version=MapVersion(self._writer.store_id, view.merged, view.fact),
            stamp_ns=view.stamp_ns,
        )

    def _view(self, window: CellWindow, as_of_ns: int | None) -> View:
        if as_of_ns is None:
            return self._writer.run(lambda store: view_now(store, window))
        fact = self._writer.run(lambda store: store.fact)
        return replace(self._past.view(window, as_of_ns, self._follower.excluded()), fact=fact)

    def _span(self, moment: SpanEvidence, names: tuple[str, ...]) -> HistorySpan:
        values = cell_layers.read(moment.evidence, names, self._config.read, moment.last_ns)
        return HistorySpan(moment.first_ns, moment.last_ns, {name: float(values[name][0, 0]) for name in names})


def reads_past(name: str, parameters: Mapping[str, str]) -> bool:
    """Whether a query folds the journal, which takes a while."""
    return name == HistoryQuery.name or not {"as_of", "minus"}.isdisjoint(parameters)


def _of_cells(names: tuple[str, ...]) -> tuple[str, ...]:
    names = cell_layers.select(names)
    if filled := [name for name in names if name in AREA_LAYERS]:
        problem = f"layer `{filled[0]}` is made from a cell's neighbours, a history is of one cell: leave it out"
        raise QueryError(Refusal.UNKNOWN_LAYER, problem)
    return names


def _with_difference(names: tuple[str, ...]) -> tuple[str, ...]:
    """Check layers to be subtracted; none means all of which there is a difference."""
    if refused := [name for name in names if name in WITHOUT_DIFFERENCE]:
        problem = f"layer `{refused[0]}` has no difference; ask for it without `minus`, as of each time"
        raise QueryError(Refusal.OUT_OF_RANGE, problem)
    return tuple(name for name in cell_layers.select(names) if name not in WITHOUT_DIFFERENCE)


def _time_of(query: HistoryQuery, now_ns: int, span_s: float) -> tuple[int, int]:
    """First and last stamp of a history; refuses too many spans before any is folded."""
    span_ns = round(span_s * 1e9)
    to_ns = query.to_ns or max(now_ns, query.from_ns or 1)
    from_ns = query.from_ns or max(1, (to_ns // span_ns - MAX_SPANS + 1) * span_ns)
    spans = to_ns // span_ns - from_ns // span_ns + 1
    if spans > MAX_SPANS:
        problem = f"{spans} spans of {span_s:g} s; at most {MAX_SPANS} are answered: a longer `span`, or less time"
        raise QueryError(Refusal.TOO_LARGE, problem)
    return from_ns, to_ns
