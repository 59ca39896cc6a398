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
    """What is stored besides the journal.

    snapshot_s: interval of grid snapshots. archive_after_h: age at which rows of a SQLite journal move to Parquet, 0
    for never. checkpoints_gb: room for checkpoints, which speed up past maps; 0 for none.
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
    """Consequences of the machines' audit.

    judge_s: interval of judgements. exclude: remove machines that contradict all others from the map, or only report
    them.
    """

    judge_s: float = 30.0
    exclude: bool = True

    def __post_init__(self) -> None:
        require_positive(self, ("judge_s",))


@dataclass(frozen=True)
class CalibrationConfig:
    """Consequences of the machines' calibration.

    automatic: apply the server's corrections, or none without a person's request.
    """

    automatic: bool = True


@dataclass(frozen=True)
class ServerConfig:
    """All options, by component."""

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
