"""The job that journals repairs of roads, found by what drove there (mapserver/query/road_maps.py)."""

from __future__ import annotations

import logging
from collections.abc import Callable

from mapserver.ingest.writer import Writer
from mapserver.roads.repair_facts import RoadRepair
from mapserver.upkeep.refolding import write
from protocol.queries.answers import MapVersion

MOST_EVENTS = 256  # in one piece of the writer's work, some ms; the next look finds the rest
Find = Callable[[], tuple[MapVersion, list[RoadRepair]] | None]
log = logging.getLogger("mapserver.upkeep.road_repairs")


class RoadRepairs:
    """Journals repairs and their withdrawals. find: those of a version of the map, None for no news."""

    name = "roads"

    def __init__(self, writer: Writer, find: Find) -> None:
        self._writer, self._find = writer, find
        self._found: tuple[MapVersion, list[RoadRepair]] | None = None  # and not yet written

    def run(self) -> None:
        """Journal what is new, unless the map has other facts by now: the next look is of these."""
        self._found = self._found or self._find()
        if not self._found:
            return
        version, events = self._found[0], self._found[1][:MOST_EVENTS]
        is_written, self._found = write(self._writer, lambda store: store.repair(version, events)), None
        for event in events if is_written else ():
            values = (event.segment, bool(event.cells), event.first_ns, event.before, event.after)
            log.info("road segment=%s changed=%s first_ns=%d before=%.4f after=%.4f", *values)
