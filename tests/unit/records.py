"""Answers of a map server as records, with plain values for all that a test does not care about."""

from __future__ import annotations

from typing import Any

from protocol.queries.answers import MachineState, MapInfo, SampleCounts, SiteInfo
from protocol.site.site_config import SiteConfig


def map_info(site: SiteConfig, **values: Any) -> MapInfo:
    zeros = ("journalled", "merged", "snapshot", "samples_merged", "samples_too_unsure", "cells", "stamp_ns", "wall_ns")
    defaults: dict[str, Any] = dict.fromkeys(zeros, 0)
    defaults |= {"site": SiteInfo(**vars(site), frame=site.frame, crs=site.crs), "version": "1.0", "bounds": None}
    defaults |= {"machines": {}, "distrusted": (), "shortfalls": (), "counters": {}, "layers": ()}
    return MapInfo(**(defaults | values))


def machine_state(name: str, **values: Any) -> MachineState:
    decision = {"trusted": True, "by": "", "reason": "", "since_ns": 0}
    audit = {"contradicts": False, "reasons": (), "evidence": {}}
    counts = vars(SampleCounts(spools=1, samples=0, lost=0, newest_ns=0, missing=0))
    return MachineState(name, **(decision | audit | counts | values))
