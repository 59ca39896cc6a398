"""Feature collections of a map by name."""

from __future__ import annotations

from collections.abc import Callable

from protocol.queries.map_tiles import TilesQuery
from protocol.queries.requests import ChangesQuery
from protocol.site.geometry import Bounds
from sitegrid.export.samples import tracks
from sitegrid.export.wanted import Wanted
from sitegrid.features.feature import Collection
from sitegrid.features.kinds import CHANGE, REPAIR, SEGMENT, WORK
from sitegrid.features.zones import zones


def _zones(wanted: Wanted) -> Collection:
    return zones(
        wanted.map.ask(TilesQuery(as_of_ns=wanted.roads.as_of_ns)), wanted.info.boundaries, wanted.roads.bounds
    )


def _changes(wanted: Wanted) -> Collection:
    bounds, as_of_ns = wanted.roads.bounds, wanted.roads.as_of_ns
    known = wanted.map.ask(ChangesQuery()).changes
    then = (one for one in known if as_of_ns is None or one.first_ns <= as_of_ns)
    return Collection(CHANGE, [one for one in then if bounds is None or bounds.shared(Bounds(*one.bounds))])


COLLECTIONS: dict[str, Callable[[Wanted], Collection]] = {
    "zones": _zones,
    "segments": lambda wanted: Collection(SEGMENT, wanted.map.ask(wanted.roads).segments),
    "worklist": lambda wanted: Collection(WORK, wanted.worklist().rows),
    "repairs": lambda wanted: Collection(REPAIR, wanted.worklist().changes),
    "changes": _changes,
    "tracks": tracks,
}
