"""Clock offsets between a log's sensors, and the manifest lines that correct them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np

from agents.clock_offsets import ClockOffsets, Offset
from protocol.arrays import Ints
from protocol.machine.log_folder import LogFolder
from protocol.machine.readings import Reading
from sitegrid.doctor import Finding, Level

ALL_DIGITS = "export the time column with all its digits"


def stands(stamps: Ints) -> bool:
    """Whether most stamps (n,) repeat, as spreadsheets leave them."""
    return len(stamps) > 1 and bool((np.diff(stamps) == 0).mean() > 1 / 2)


def check_clocks(log: LogFolder, readings: Mapping[str, Sequence[Reading]]) -> Iterator[Finding]:
    """Sensors with a deviating clock. readings: by sensor, in file order.

    FAIL if a sensor's stamps overlap with no other's, which makes it useless.
    """
    spans = {name: (rows[0].stamp_ns, rows[-1].stamp_ns) for name, rows in readings.items() if rows}
    offsets = _offsets(log, readings, spans)
    for name, span in spans.items():
        offset = offsets.get(name)
        if not any(_overlap(span, other) for sensor, other in spans.items() if sensor != name) and len(spans) > 1:
            what = f"its stamps are from {time_of(span[0])} to {time_of(span[1])}, when no other sensor has any"
            unknown = "look at the unit of its stamp, and at `start_ns`, which is for all"
            yield Finding(Level.FAIL, name, what, _proposal(offset) if offset else unknown)
        elif offset:
            others = ", ".join(offset.others)
            what = f"its stamps are {abs(offset.ahead_s):.1f} s {offset.where} those of {others}, by the motion"
            yield Finding(Level.WARN, name, what, _proposal(offset))


def _offsets(
    log: LogFolder, readings: Mapping[str, Sequence[Reading]], spans: Mapping[str, tuple[int, int]]
) -> dict[str, Offset]:
    """Offsets by sensor; a sensor without motion takes that of the sensor with the same apparent clock."""
    clocks = ClockOffsets(log.machine, log.site)
    for rows in readings.values():
        clocks.take(rows)
    of_manifest_s = {source.sensor.name: source.ahead_s for source in log.sources}
    offsets = {o.sensor: replace(o, delay_s=o.delay_s + of_manifest_s[o.sensor]) for o in clocks.find()}
    right = {name for offset in offsets.values() for name in offset.others}
    for name in spans.keys() - offsets.keys() - right if offsets else ():
        like = [o for o in offsets.values() if _overlap(spans[name], spans[o.sensor])]
        if like and not any(_overlap(spans[name], spans[other]) for other in right):
            offsets[name] = replace(like[0], sensor=name)
    return offsets


def time_of(stamp_ns: int) -> str:
    """A stamp for people."""
    return f"{datetime.fromtimestamp(stamp_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _overlap(one: tuple[int, int], other: tuple[int, int]) -> bool:
    return one[0] <= other[1] and other[0] <= one[1]


def _proposal(offset: Offset) -> str:
    return f"write `delay_s = {offset.delay_s:.1f}` under its name (+- {2 * offset.std_s:.1f} s)"
