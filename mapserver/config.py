"""The map server's options (config/server.toml)."""

from __future__ import annotations

from dataclasses import dataclass, field

from mapserver.change.detection import ChangeConfig
from mapserver.evidence.votes import FoldConfig
from mapserver.layers.cell_layers import ReadConfig
from mapserver.trust.auditor import TrustConfig
from protocol.config import require_positive


@dataclass(frozen=True)
class StoreConfig:
    """Sizes of the writer's queue and its groups, and how often it makes a snapshot.

    queue_batches: so many batches may wait before senders are told to wait. group_batches: at most so many are
    committed together. snapshot_rows, snapshot_s: a snapshot is made after so many journal rows or seconds.
    """

    queue_batches: int = 256
    group_batches: int = 64
    snapshot_rows: int = 2000
    snapshot_s: float = 60.0

    def __post_init__(self) -> None:
        if min(self.queue_batches, self.group_batches, self.snapshot_rows) < 1 or self.snapshot_s <= 0:
            raise ValueError("queue_batches, group_batches, snapshot_rows and snapshot_s must be positive")


@dataclass(frozen=True)
class KeepConfig:
    """What the keeper does beside the map.

    turn_s: it looks for new rows and changes so often. judge_s: machines are judged so often. distrusts: whether
    machines that contradict all others are left out of the map, or only named. archive_after_h: rows move to Parquet
    files once they are so old, 0 for never.
    """

    turn_s: float = 1.0
    judge_s: float = 30.0
    distrusts: bool = True
    archive_after_h: float = 24.0

    def __post_init__(self) -> None:
        require_positive(self, ("turn_s", "judge_s"))
        if not self.archive_after_h >= 0:
            raise ValueError("archive_after_h: negative")


@dataclass(frozen=True)
class ServerConfig:
    """All options, one table per component."""

    store: StoreConfig = field(default_factory=StoreConfig)
    fold: FoldConfig = field(default_factory=FoldConfig)
    read: ReadConfig = field(default_factory=ReadConfig)
    change: ChangeConfig = field(default_factory=ChangeConfig)
    trust: TrustConfig = field(default_factory=TrustConfig)
    keep: KeepConfig = field(default_factory=KeepConfig)
    query_threads: int = 2

    def __post_init__(self) -> None:
        if not 1 <= self.query_threads <= 64:
            raise ValueError(f"query_threads: {self.query_threads} is not between 1 and 64")
