"""Days of haulers on known roads, and a site on the web with their map."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from protocol.arrays import Table
from protocol.queries.roads import WorklistQuery
from protocol.wire.codec import encode_batch
from protocol.wire.messages import SampleBatch
from sitegrid.process.children import Children
from tests.integration.web_site import WebSite
from tests.patience import until
from tests.soak import BATCH_S
from tests.unit.mapserver.roads.drives import START_NS, along, passes

DAY_S, DAYS = 86_400.0, 4
DAY_NS = round(DAY_S * 1e9)
FIRST_NS = START_NS // DAY_NS * DAY_NS
WORSE, REPAIRED, UNWEIGHED = (along([(10, y), (160, y)]) for y in (10.0, 70.0, 130.0))
BETWEEN = along([(10, 10), (10, 130)])  # joins them in the west
PASSES = 5


class Hauler:
    """A machine with a daily batch of passes over roads."""

    def __init__(self, name: str, days: list[Table]) -> None:
        self.name, self._days, self._seq = name, days, 0

    def drive(self, from_s: float, frame: str) -> bytes:
        """The batch of the day at `from_s`, BATCH_S per day."""
        rows = self._days[round(from_s / BATCH_S)]
        batch = SampleBatch(self.name, 7, self._seq + 1, rows, frame)
        self._seq += len(rows)
        return encode_batch(batch)


def haulers() -> list[Hauler]:
    """Three machines on separate roads: one worsens by 0.005 a day, one is repaired on the last, one has no mass."""
    at = [day * DAY_S for day in range(DAYS)]
    worse = [passes(WORSE, PASSES, 0.04 + 0.005 * day, day, at[day]) for day in range(DAYS)]
    repaired = [passes(REPAIRED, PASSES, 0.05 if day < DAYS - 1 else 0.03, day, at[day]) for day in range(DAYS)]
    unweighed = [passes(UNWEIGHED, PASSES, 0.03, day, at[day], math.nan) for day in range(DAYS)]
    joined = [passes(BETWEEN, 2, 0.02, day, at[day] + 3600.0) for day in range(DAYS)]
    return [
        Hauler("hauler-1", [np.concatenate(parts) for parts in zip(worse, joined, strict=True)]),
        Hauler("hauler-2", repaired),
        Hauler("hauler-3", unweighed),
    ]


def hauling_site(folder: Path, children: Children) -> WebSite:
    site = WebSite(folder, children)
    site.machines = haulers()  # type: ignore[assignment]
    site.drive(DAYS * BATCH_S)
    site.client.ask(WorklistQuery(after=site.client.info().merged))  # roads now include all drives
    until(lambda: site.client.ask(WorklistQuery()).changes, "the repair of a road in the journal")
    return site
