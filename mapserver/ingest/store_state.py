"""The state of a store for people and programs (`info`), from counters: nothing is counted anew."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mapserver.ingest.map_info import map_info

if TYPE_CHECKING:
    from mapserver.ingest.store import Store


def state_of(store: Store) -> dict[str, Any]:
    """Plain values; on the thread that owns the store."""
    info = map_info(store.site, store.grid, store.facts, store.version, store.newest_ns, store.now_ns())
    return info | {
        "descends": list(store.identity.descends),
        "accepted": sorted(store.accepted),
        "epoch": store.journal.epoch,
        "replica": store.journal.replica,
        "decided": store.decided,
        "journalled": store.journalled,
        "snapshot": store.snapshot_row,
        "machines": store.machines(),
        "shortfalls": [str(shortfall) for shortfall in store.shortfalls],
        "counters": dict(store.counters),
    }
