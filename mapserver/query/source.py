"""What queries are answered from: the same small protocol for the process that writes and for one that follows."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any, Protocol, TypeVar

from mapserver.config import ServerConfig
from mapserver.evidence.grid import Grid
from mapserver.ingest.merge_waits import MergeWaits
from mapserver.journal.facts import Facts
from mapserver.journal.location import JournalLocation
from mapserver.past.past import StorePast
from protocol.queries.answers import GroundChange, MapVersion, ServerAlive
from protocol.queries.calibration import CalibrationAnswer
from protocol.queries.origin import Origin
from protocol.site.site_config import SiteConfig

T = TypeVar("T")


class MapState(Protocol):
    """A map as it is: nothing changes it while somebody has it."""

    @property
    def site(self) -> SiteConfig:
        """Whose map it is."""

    @property
    def config(self) -> ServerConfig:
        """How it is folded and read."""

    @property
    def grid(self) -> Grid:
        """Its evidence."""

    @property
    def facts(self) -> Facts:
        """What it is folded with."""

    @property
    def version(self) -> MapVersion:
        """The version that it is."""

    @property
    def newest_ns(self) -> int:
        """The site's now: the newest stamp of the machines that are in it, 0 for none."""

    def machines(self) -> Collection[str]:
        """Names of all machines that have sent anything."""


class MapSource(Protocol):
    """Whoever has the map of a site; for any thread. Each call may raise QueryError. waits: who waits for a row."""

    site: SiteConfig
    config: ServerConfig
    waits: MergeWaits

    @property
    def location(self) -> JournalLocation:
        """Where the journal is."""

    @property
    def past(self) -> StorePast:
        """What maps of the past are read from."""

    def run(self, work: Callable[[MapState], T]) -> T:
        """Have `work` done with the map as it is; it has to be short."""

    def changes(self, after: int) -> list[GroundChange]:
        """Changes of the ground with a number beyond `after`."""

    def machines(self) -> list[dict[str, Any]]:
        """State of every machine, as plain values."""

    def calibration(self) -> CalibrationAnswer:
        """What is taken off the samples of all machines."""

    def info(self) -> dict[str, Any]:
        """State of the map and of its process, as plain values."""

    def alive(self) -> ServerAlive:
        """Whether the process does its work, without waiting for anything."""

    def origin(self) -> Origin:
        """Who answers, and how far behind the journal."""

    def count(self, what: str) -> None:
        """Count what became of a query, for `info`."""
