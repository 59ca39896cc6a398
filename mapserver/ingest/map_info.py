"""What `info` says of a map and its process, whether the process writes or follows."""

from __future__ import annotations

import os
import socket
from dataclasses import asdict
from typing import Any

from mapserver.evidence.grid import Grid
from mapserver.journal.facts import Facts
from protocol.queries.answers import MapVersion
from protocol.site.site_config import SiteConfig
from protocol.version import package_version


def map_info(
    site: SiteConfig, grid: Grid, facts: Facts, version: MapVersion, newest_ns: int, now_ns: int
) -> dict[str, Any]:
    """Plain values, from counters. newest_ns: the site's now. now_ns: the clock of this process."""
    counts = grid.counts()
    return {
        "site": {**asdict(site), "frame": site.frame, "crs": site.crs},
        "store": version.store,
        "merged": version.row,
        "fact": version.fact,
        "corrections": len(facts.corrections),
        "distrusted": sorted(facts.excluded),
        "samples_merged": counts.folded,
        "samples_too_unsure": counts.skipped,
        "cells": counts.cells,
        "bounds": counts.bounds,
        "first_ns": grid.oldest_ns,
        "stamp_ns": newest_ns,
        "wall_ns": now_ns,
        "version": package_version(),
        "server": {"host": socket.gethostname(), "pid": os.getpid()},
    }
