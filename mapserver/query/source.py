"""Sources of answers: one protocol for the writing process and for followers."""

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
    """A map, constant while in use."""

    @property
    def site(self) -> SiteConfig:
        """Its site."""

    @property
    def config(self) -> ServerConfig:
        """How it is folded and read."""

    @property
    def grid(self) -> Grid:
        """Its evidence."""

    @property
    def facts(self) -> Facts:
        """Its facts."""

    @property
    def version(self) -> MapVersion:
        """Its version."""

    @property
    def newest_ns(self) -> int:
        """The site's now: newest stamp of machines in the map, 0 for none."""

    def machines(self) -> Collection[str]:
        """Names of machines that have sent samples."""


class MapReading(Protocol):
    """A site's map and its past; thread-safe. Each call may raise QueryError."""

    site: SiteConfig
    config: ServerConfig

    @property
    def location(self) -> JournalLocation:
        """Location of the journal."""

    @property
    def past(self) -> StorePast:
        """Sources of past maps."""

    def run(self, work: Callable[[MapState], T]) -> T:
        """Run short `work` on the present map."""


class MapSource(MapReading, Protocol):
    """A source of a site's map. waits: for journal rows."""

    waits: MergeWaits

    def changes(self, after: int) -> list[GroundChange]:
        """Changes numbered above `after`."""

    def machines(self) -> list[dict[str, Any]]:
        """State of every machine, as plain values."""

    def calibration(self) -> CalibrationAnswer:
        """Corrections of all machines."""

    def info(self) -> dict[str, Any]:
        """State of map and process, as plain values."""

    def alive(self) -> ServerAlive:
        """Whether the process works, without waiting."""

    def origin(self) -> Origin:
        """Who answers, and how far behind the journal."""

    def count(self, what: str) -> None:
        """Count a query's outcome, for `info`."""
