"""Answers of map queries as values (docs/protocol.md, "Map queries"); bytes: `answer_codec.py`.

Stamps are UTC nanoseconds. `version`: of the map, `merged`: its journal row; `stamp_ns`: the site's now, or the map's
time.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from protocol.arrays import Floats, Floats32
from protocol.site.geometry import Bounds
from protocol.site.site_config import KnownGround


@dataclass(frozen=True)
class MapVersion:
    """A reproducible map. store: id of the store; row: last merged journal row; fact: last decision in it, or 0."""

    store: str
    row: int
    fact: int


class _OfVersion:
    """An answer of one map version."""

    version: MapVersion

    @property
    def merged(self) -> int:
        """Last merged journal row."""
        return self.version.row


@dataclass(frozen=True)
class PointAnswer(_OfVersion):
    """Layers of the cell with centre (x_m, y_m); NaN is unknown."""

    x_m: float
    y_m: float
    values: Mapping[str, float]
    version: MapVersion
    stamp_ns: int


@dataclass(frozen=True, repr=False)
class PointsAnswer(_OfVersion):
    """Layers of n cells: x_m, y_m (n,): centres; layers: name -> float32 (n,), NaN if unknown."""

    x_m: Floats
    y_m: Floats
    layers: Mapping[str, Floats32]
    version: MapVersion
    stamp_ns: int

    def __getitem__(self, layer: str) -> Floats32:
        return self.layers[layer]

    def __repr__(self) -> str:
        return f"<{len(self.x_m)} places: {', '.join(self.layers)}>"


@dataclass(frozen=True)
class Piece:
    """A piece's place in its region.

    cursor: of the region's map version. number: 0 to count - 1. column, row: south-western cell in the region of
    columns x rows cells.
    """

    cursor: int
    number: int
    count: int
    column: int
    row: int
    columns: int
    rows: int


@dataclass(frozen=True, repr=False)
class Region(_OfVersion):
    """A rectangle of cells.

    x_m (columns,), y_m (rows,): centres in `map`, growing east and north. layers: name -> float32 (rows, columns),
    southernmost row first, NaN if unknown. piece: None for a whole region.
    """

    x_m: Floats
    y_m: Floats
    cell_m: float
    layers: Mapping[str, Floats32]
    version: MapVersion
    stamp_ns: int
    piece: Piece | None = None

    def __getitem__(self, layer: str) -> Floats32:
        return self.layers[layer]

    def __repr__(self) -> str:
        edge = self.bounds
        known = max((float(np.isfinite(values).mean()) for values in self.layers.values()), default=0.0)
        size = f"{len(self.x_m)} x {len(self.y_m)} cells of {self.cell_m:g} m"
        place = f"{edge.west_m:g}..{edge.east_m:g}, {edge.south_m:g}..{edge.north_m:g} m"
        return f"<{size} at {place}, {known:.0%} known: {', '.join(self.layers)}>"

    @property
    def bounds(self) -> Bounds:
        """Outer edges [m]."""
        half = self.cell_m / 2
        return Bounds(self.x_m[0] - half, self.y_m[0] - half, self.x_m[-1] + half, self.y_m[-1] + half)


@dataclass(frozen=True)
class HistorySpan:
    """Layers of a cell from samples with first_ns <= stamp <= last_ns; NaN is unknown."""

    first_ns: int
    last_ns: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class HistoryAnswer(_OfVersion):
    """The cell with centre (x_m, y_m) over time, oldest first, without empty spans."""

    x_m: float
    y_m: float
    spans: tuple[HistorySpan, ...]
    version: MapVersion
    stamp_ns: int


@dataclass(frozen=True)
class SiteInfo:
    """The server's `SiteConfig`, with frame id and PROJ string."""

    name: str
    origin_lat_deg: float
    origin_lon_deg: float
    origin_height_m: float
    cell_m: float
    extent_m: float
    clock: str
    clock_tolerance_s: float
    known_ground: tuple[KnownGround, ...]
    frame: str
    crs: str


@dataclass(frozen=True)
class SampleCounts:
    """A machine's counts: spools, accepted samples, declared losses, newest stamp.

    missing: acknowledged samples that are gone, neither sent again nor declared lost.
    """

    spools: int
    samples: int
    lost: int
    newest_ns: int
    missing: int


@dataclass(frozen=True)
class CheckpointCounts:
    """Checkpoints, from which maps of the past are made.

    count: usable ones. bytes: of all. newest_ns: end of the newest usable one, or 0. passed_over: damaged since the
    start.
    """

    count: int
    bytes: int
    newest_ns: int
    passed_over: int


@dataclass(frozen=True)
class ServerProcess:
    """Process of a map server."""

    host: str
    pid: int


@dataclass(frozen=True)
class MapInfo:
    """State of map and server.

    store: its id; descends: stores it was folded from; accepted: stores a person let it replace; epoch: of its server
    among all its writers; replica: of its disk, "synchronous", "asynchronous" or "none". fact: see MapVersion; decided:
    last decision about a machine; beyond `fact`, the map is being folded again; corrections: number of corrected spans.
    journalled, merged, snapshot: journal rows. bounds: first column, first row, end column, end row of blocks with
    evidence, or None. first_ns, stamp_ns: oldest stamp, and the site's now; or 0. wall_ns: the server's clock.
    distrusted: excluded machines. boundaries: of resistance classes. shortfalls: acknowledged rows the journal lacked,
    a line per start.
    """

    site: SiteInfo
    store: str
    descends: tuple[str, ...]
    accepted: tuple[str, ...]
    epoch: int
    replica: str
    fact: int
    decided: int
    corrections: int
    journalled: int
    merged: int
    snapshot: int
    samples_merged: int
    samples_too_unsure: int
    cells: int
    bounds: tuple[int, int, int, int] | None
    first_ns: int
    stamp_ns: int
    wall_ns: int
    version: str
    server: ServerProcess
    checkpoints: CheckpointCounts
    machines: Mapping[str, SampleCounts]
    distrusted: tuple[str, ...]
    shortfalls: tuple[str, ...]
    counters: Mapping[str, int]
    layers: tuple[str, ...]
    boundaries: tuple[float, ...]


@dataclass(frozen=True)
class ServerAlive:
    """A map server that takes batches. journalled, merged: journal rows. busy_s: age of its current work, or 0."""

    store: str
    journalled: int
    merged: int
    busy_s: float


@dataclass(frozen=True)
class FollowerState:
    """An answering follower. store, merged: see MapVersion; journalled: last journal row it knows.

    behind_rows: rows its map lacks. behind_s: upper bound of its map's lag.
    """

    name: str
    store: str
    journalled: int
    merged: int
    behind_rows: int
    behind_s: float

    def __str__(self) -> str:
        return f"{self.name}: journal row {self.merged}, {self.behind_rows} rows and {self.behind_s:.1f} s behind"


@dataclass(frozen=True)
class MachineState:
    """The map server's view of a machine.

    trusted: its samples are in the map. by: last decision by `audit` (the server), `person`, or empty. reason: one
    line. since_ns: the site's now then, or 0. contradicts: it contradicts all others now; reasons, evidence: in what,
    with figures. Counts: see SampleCounts.
    """

    name: str
    trusted: bool
    by: str
    reason: str
    since_ns: int
    contradicts: bool
    reasons: tuple[str, ...]
    evidence: Mapping[str, Any]
    spools: int
    samples: int
    lost: int
    newest_ns: int
    missing: int


@dataclass(frozen=True)
class TrustAnswer(MachineState):
    """A machine after a command, and the map version in which it counts."""

    store: str
    merged: int
    fact: int


@dataclass(frozen=True)
class MachinesAnswer(_OfVersion):
    """All machines that have sent."""

    machines: tuple[MachineState, ...]
    version: MapVersion


@dataclass(frozen=True)
class GroundChange:
    """A change of the ground.

    id: 1, 2, 3... first_ns, last_ns: it happened in between, cell by cell. bounds: west, south, east, north [m]. cells:
    known to have changed. resistance [-], grade [m/m]: medians, None if unknown.
    """

    id: int
    first_ns: int
    last_ns: int
    bounds: tuple[float, float, float, float]
    cells: int
    resistance_before: float | None
    resistance_after: float | None
    grade_before: float | None
    grade_after: float | None


@dataclass(frozen=True)
class ChangesAnswer(_OfVersion):
    """Changes of the ground, by id."""

    changes: tuple[GroundChange, ...]
    version: MapVersion
