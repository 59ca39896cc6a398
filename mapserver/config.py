"""The map server's options (config/server.toml)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from mapserver.change.detection import ChangeConfig
from mapserver.evidence.fold_config import FoldConfig
from mapserver.layers.cell_layers import ReadConfig
from protocol.config import require_positive


@dataclass(frozen=True)
class StoreConfig:
    """What is kept on disk beside the journal.

    snapshot_s: a snapshot of the grid is written so often. archive_after_h: rows of a journal in SQLite move to Parquet
    files once they are so old, 0 for never. checkpoints_gb: so much room have checkpoints, which make maps of the past
    quick; 0 for none.
    """

    snapshot_s: float = 60.0
    archive_after_h: float = 24.0
    checkpoints_gb: float = 5.0

    def __post_init__(self) -> None:
        require_positive(self, ("snapshot_s",))
        for name in ("archive_after_h", "checkpoints_gb"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: {getattr(self, name)} is not 0 or more")


@dataclass(frozen=True)
class TrustConfig:
    """What follows from the audit of machines.

    judge_s: machines are judged so often. exclude: whether machines that contradict all others are excluded from the
    map, or only named.
    """

    judge_s: float = 30.0
    exclude: bool = True

    def __post_init__(self) -> None:
        require_positive(self, ("judge_s",))


@dataclass(frozen=True)
class CalibrationConfig:
    """What follows from the calibration of machines.

    automatic: whether samples are corrected by what the server finds, or by nothing until a person asks.
    """

    automatic: bool = True


@dataclass(frozen=True)
class ServerConfig:
    """All options, one table per component."""

    store: StoreConfig = field(default_factory=StoreConfig)
    fold: FoldConfig = field(default_factory=FoldConfig)
    read: ReadConfig = field(default_factory=ReadConfig)
    change: ChangeConfig = field(default_factory=ChangeConfig)
    trust: TrustConfig = field(default_factory=TrustConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    query_threads: int = 2

    def __post_init__(self) -> None:
        if not 1 <= self.query_threads <= 64:
            raise ValueError(f"query_threads: {self.query_threads} is not between 1 and 64")
