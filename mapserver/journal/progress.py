"""How far all spools have come, and what that comes to for each machine: kept up to date, never counted anew."""

from __future__ import annotations

from collections.abc import Mapping

from mapserver.journal.rows import MachineTotals, SpoolKey, Watermark


class Progress:
    """Watermarks of all spools. samples: that all machines sent."""

    def __init__(self, watermarks: Mapping[SpoolKey, Watermark]) -> None:
        self._watermarks: dict[SpoolKey, Watermark] = {}
        self._machines: dict[str, MachineTotals] = {}
        self.samples = 0
        for (machine, spool_id), watermark in watermarks.items():
            self.put(machine, spool_id, watermark)

    def watermark(self, machine: str, spool_id: int) -> Watermark:
        """Progress of one spool."""
        return self._watermarks.get((machine, spool_id), Watermark())

    def known(self, spool: SpoolKey) -> Watermark | None:
        """Progress of one spool, None for one that there is not."""
        return self._watermarks.get(spool)

    def watermarks(self) -> dict[SpoolKey, Watermark]:
        """Progress of all spools."""
        return dict(self._watermarks)

    def machines(self) -> dict[str, MachineTotals]:
        """What each machine sent."""
        return dict(self._machines)

    def put(self, machine: str, spool_id: int, after: Watermark) -> None:
        """Replace a watermark."""
        before, totals = self._watermarks.get((machine, spool_id)), self._machines.get(machine, MachineTotals())
        self._watermarks[machine, spool_id] = after
        known = before or Watermark()
        samples = (after.seq - after.lost) - (known.seq - known.lost)
        self.samples += samples
        self._machines[machine] = MachineTotals(
            spools=totals.spools + (before is None),
            samples=totals.samples + samples,
            lost=totals.lost + after.lost - known.lost,
            newest_ns=max(totals.newest_ns, after.newest_ns),
        )
