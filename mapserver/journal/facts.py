"""Facts: what a map depends on besides samples, by the journal's decisions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from mapserver.calibration.correction import UNCORRECTED, SampleCorrections
from mapserver.roads.repair_facts import NO_REPAIRS, Repairs
from protocol.machine.readings import MAX_STAMP_NS


@dataclass(frozen=True)
class Facts:
    """Facts about machines and roads.

    excluded: not in the map. corrections: of the other machines. repairs: of roads, applied when evidence is read.
    number: of the last decision, 0 for none. The last two are not compared, so facts are equal if grids are.
    """

    excluded: frozenset[str] = frozenset()
    corrections: SampleCorrections = UNCORRECTED
    number: int = field(default=0, compare=False)
    repairs: Repairs = field(default=NO_REPAIRS, compare=False)

    def of_evidence(self, before_ns: int = MAX_STAMP_NS) -> Mapping[str, object]:
        """Dependencies of evidence stamped before a time, which is rebuilt if they change."""
        return {"excluded": sorted(self.excluded), "corrections": self.corrections.digest(before_ns)}


NO_FACTS = Facts()
