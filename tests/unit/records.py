"""Map server answers as records, with defaults for what tests ignore."""

from __future__ import annotations

from dataclasses import fields
from typing import Any

from protocol.queries.answers import (
    CheckpointCounts,
    MachineState,
    MapInfo,
    MapVersion,
    SampleCounts,
    ServerProcess,
    SiteInfo,
)
from protocol.site.site_config import SiteConfig

STORE = "0123456789abcdef"


def version(row: int = 0, fact: int = 0) -> MapVersion:
    return MapVersion(STORE, row, fact)


def site_info(site: SiteConfig) -> SiteInfo:
    values = {item.name: getattr(site, item.name) for item in fields(site)}
    return SiteInfo(**values, frame=site.frame, crs=site.crs)


def map_info(site: SiteConfig, **values: Any) -> MapInfo:
    rows = ("epoch", "fact", "decided", "corrections", "journalled", "merged", "snapshot")
    zeros = (*rows, "samples_merged", "samples_too_unsure", "cells", "first_ns", "stamp_ns", "wall_ns")
    defaults: dict[str, Any] = dict.fromkeys(zeros, 0)
    defaults |= {"site": site_info(site), "version": "1.0", "bounds": None}
    defaults |= {
        "store": STORE,
        "descends": (),
        "accepted": (),
        "replica": "none",
        "server": ServerProcess("office", 7),
    }
    defaults |= {"checkpoints": CheckpointCounts(0, 0, 0, 0)}
    defaults |= {"machines": {}, "distrusted": (), "shortfalls": (), "counters": {}, "layers": (), "boundaries": ()}
    return MapInfo(**(defaults | values))


def machine_state(name: str, **values: Any) -> MachineState:
    decision = {"trusted": True, "by": "", "reason": "", "since_ns": 0}
    audit = {"contradicts": False, "reasons": (), "evidence": {}}
    counts = vars(SampleCounts(spools=1, samples=0, lost=0, newest_ns=0, missing=0))
    return MachineState(name, **(decision | audit | counts | values))
