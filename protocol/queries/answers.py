"""Answers to map queries as values (docs/protocol.md, "Map queries"); their bytes: `answer_codec.py`.

Stamps are UTC in nanoseconds. `version` is the version of the map that an answer is true for, `merged` its journal row;
`stamp_ns` is the site's now, or the time that the map is as of.
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
    """A map that anybody can make again. store: id of the store; row: its last journal row that is in the map.

    fact: number of the last fact that is, 0 for none; a fact is a decision about a machine.
    """

    store: str
    row: int
    fact: int


class _OfVersion:
    """An answer that is true for one version of the map."""

    version: MapVersion

    @property
    def merged(self) -> int:
        """The last journal row in the map."""
        return self.version.row


@dataclass(frozen=True)
class PointAnswer(_OfVersion):
    """Layer values of the cell with centre (x_m, y_m); NaN is unknown."""

    x_m: float
    y_m: float
    values: Mapping[str, float]
    version: MapVersion
    stamp_ns: int


@dataclass(frozen=True, repr=False)
class PointsAnswer(_OfVersion):
    """Layers of n cells: x_m, y_m (n,) their centres; layers: name -> float32 (n,), NaN where unknown."""

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
    """Where a piece lies in the region that was asked for.

    cursor: names the version of the map that the region is read from. number: of this piece, 0 to count - 1. column,
    row: its south-western cell in the region, which has columns x rows cells.
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

    x_m (columns,), y_m (rows,): cell centres in `map`, growing east and north. layers: name -> float32 (rows, columns),
    NaN where unknown; row 0 is the southernmost. piece: where this is a piece of a larger region; None for all of it.
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
    """Layer values of one cell from its samples with first_ns <= stamp <= last_ns alone; NaN is unknown."""

    first_ns: int
    last_ns: int
    values: Mapping[str, float]


@dataclass(frozen=True)
class HistoryAnswer(_OfVersion):
    """The cell with centre (x_m, y_m) over time, oldest first; a span without samples is not there."""

    x_m: float
    y_m: float
    spans: tuple[HistorySpan, ...]
    version: MapVersion
    stamp_ns: int


@dataclass(frozen=True)
class SiteInfo:
    """The site as its map server has it: `SiteConfig`, with the digits and the PROJ string of its frame."""

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
    """What one machine sent: spools, samples accepted, samples that it declared lost, and its newest stamp.

    missing: samples that were acknowledged, are gone, and that it has neither sent again nor declared lost since.
    """

    spools: int
    samples: int
    lost: int
    newest_ns: int
    missing: int


@dataclass(frozen=True)
class CheckpointCounts:
    """Checkpoints of the evidence, from which maps of the past are made.

    count: of those that can be used. bytes: of all. newest_ns: when the newest one that can be used is closed, 0 for
    none. passed_over: how many were damaged since the start.
    """

    count: int
    bytes: int
    newest_ns: int
    passed_over: int


@dataclass(frozen=True)
class ServerProcess:
    """Where a map server runs."""

    host: str
    pid: int


@dataclass(frozen=True)
class MapInfo:
    """State of the map and its server.

    store: its id; descends: ids of the stores that it was folded from; accepted: ids of those whose place a person let
    it take; epoch: number of its server among all that ever wrote it; replica: what stands behind its disk:
    "synchronous", "asynchronous" or "none". fact: see MapVersion; decided: number of the last decision about a machine
    that there is: the map is folded again for it where it is beyond `fact`; corrections: how many stretches of samples
    have one. journalled, merged, snapshot: journal rows. bounds: first column, first row, end column and end row of the
    blocks with evidence; None without any. first_ns, stamp_ns: the map's oldest stamp, and the site's now; 0 without
    any. wall_ns: the server's clock. distrusted: machines whose samples are excluded. boundaries: of the classes of
    resistance. shortfalls: what the journal lacked of what was acknowledged, one line for each start that noticed.
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
    """A map server that takes batches. journalled, merged: journal rows.

    busy_s: how long it has been at the work that it does now, 0 for none.
    """

    store: str
    journalled: int
    merged: int
    busy_s: float


@dataclass(frozen=True)
class FollowerState:
    """A follower that answers. store, merged: see MapVersion; journalled: the last row of the journal, as it knows.

    behind_rows: rows that its map lacks. behind_s: its map had all that was in the journal so long ago, or later.
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
    """What the map server knows of one machine.

    trusted: whether its samples are in the map. by: who decided that last: `audit` (the server), `person`, or empty.
    reason: one line. since_ns: the site's now at the decision, 0 for never. contradicts: whether it contradicts all
    others now. reasons, evidence: in what, and by which figures. The counts: see SampleCounts.
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
    """The machine after a command, and the version of the map that the command counts in: see MapVersion."""

    store: str
    merged: int
    fact: int


@dataclass(frozen=True)
class MachinesAnswer(_OfVersion):
    """All machines that have sent something."""

    machines: tuple[MachineState, ...]
    version: MapVersion


@dataclass(frozen=True)
class GroundChange:
    """One change of the ground.

    id: 1, 2, 3... first_ns, last_ns: between them it took place, cell by cell. bounds: west, south, east, north [m].
    cells: how many are known to have changed. resistance [-], grade [m/m]: medians over them; None is unknown.
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
    """Changes of the ground, in the order of their ids."""

    changes: tuple[GroundChange, ...]
    version: MapVersion
