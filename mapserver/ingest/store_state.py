"""The state of a store for people and programs (`info`), from counters: nothing is counted anew."""

from __future__ import annotations

import os
import socket
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from protocol.version import package_version

if TYPE_CHECKING:
    from mapserver.ingest.store import Store


def state_of(store: Store) -> dict[str, Any]:
    """Plain values; on the thread that owns the store."""
    counts = store.grid.counts()
    return {
        "site": {**asdict(store.site), "frame": store.site.frame, "crs": store.site.crs},
        "store": store.identity.id,
        "descends": list(store.identity.descends),
        "accepted": sorted(store.accepted),
        "epoch": store.journal.epoch,
        "replica": store.journal.replica,
        "fact": store.fact,
        "decided": store.decided,
        "corrections": len(store.facts.corrections),
        "journalled": store.journalled,
        "merged": store.merged,
        "snapshot": store.snapshot_row,
        "samples_merged": counts.folded,
        "samples_too_unsure": counts.skipped,
        "cells": counts.cells,
        "bounds": counts.bounds,
        "first_ns": store.grid.oldest_ns,
        "stamp_ns": store.newest_ns,
        "wall_ns": store.now_ns(),
        "version": package_version(),
        "server": {"host": socket.gethostname(), "pid": os.getpid()},
        "machines": store.machines(),
        "distrusted": sorted(store.facts.excluded),
        "shortfalls": [str(shortfall) for shortfall in store.shortfalls],
        "counters": dict(store.counters),
    }
