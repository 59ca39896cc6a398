"""Facts: what a map depends on beside its samples, as decisions in the journal say it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from mapserver.calibration.correction import UNCORRECTED, SampleCorrections
from protocol.machine.readings import MAX_STAMP_NS


@dataclass(frozen=True)
class Facts:
    """What counts about machines.

    excluded: machines whose samples are not in the map. corrections: what is taken off the others' samples. number: of
    the last decision that is counted, 0 for none; facts are equal that make equal maps.
    """

    excluded: frozenset[str] = frozenset()
    corrections: SampleCorrections = UNCORRECTED
    number: int = field(default=0, compare=False)

    def of_evidence(self, before_ns: int = MAX_STAMP_NS) -> Mapping[str, object]:
        """What evidence of samples stamped before a time depends on; it is made again where this is not the same."""
        return {"excluded": sorted(self.excluded), "corrections": self.corrections.digest(before_ns)}


NO_FACTS = Facts()
