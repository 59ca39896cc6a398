"""Answers of a map server as records, with plain values for all that a test does not care about."""

from __future__ import annotations

from typing import Any

from protocol.queries.answers import MachineState, MapInfo, SampleCounts, SiteInfo
from protocol.site.site_config import SiteConfig


def map_info(site: SiteConfig, **values: Any) -> MapInfo:
    defaults: dict[str, Any] = {
        "site": SiteInfo(**vars(site), frame=site.frame, crs=site.crs),
        "journalled": 0,
        "merged": 0,
        "snapshot": 0,
        "samples_merged": 0,
        "samples_too_unsure": 0,
        "cells": 0,
        "bounds": None,
        "stamp_ns": 0,
        "wall_ns": 0,
        "version": "1.0",
        "machines": {},
        "distrusted": (),
        "counters": {},
        "layers": (),
    }
    return MapInfo(**(defaults | values))


def machine_state(name: str, **values: Any) -> MachineState:
    decision = {"trusted": True, "by": "", "reason": "", "since_ns": 0}
    audit = {"contradicts": False, "reasons": (), "evidence": {}}
    counts = vars(SampleCounts(spools=1, samples=0, lost=0, newest_ns=0))
    return MachineState(name, **(decision | audit | counts | values))
