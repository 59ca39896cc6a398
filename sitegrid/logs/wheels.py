"""A recording's wheel sensors, judged as by an agent: which were excluded, and when."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from heapq import merge
from itertools import groupby
from operator import attrgetter

from agents.dead_reckoning import DeadReckoning
from agents.localisation.wheels.judge import WheelJudge
from agents.stream_order import by_stamp
from protocol.machine.log_folder import LogFolder
from protocol.machine.readings import Reading
from protocol.site.site_config import Projection
from sitegrid.doctor import Finding, Level

LOOK_NS = 10**9


def check_wheels(log: LogFolder, readings: Sequence[Sequence[Reading]]) -> Iterator[Finding]:
    """Faults of wheels. readings: per sensor in use, by stamp."""
    sensors = {sensor.name: sensor for sensor in log.machine.sensors if sensor.use}
    judge, reckoned = WheelJudge(log.machine, Projection(log.site)), DeadReckoning(log.machine, 0.0)
    first_ns = looked_ns = stamp_ns = 0
    begun: dict[tuple[str, str], float] = {}
    stamped = attrgetter("stamp_ns")
    for stamp_ns, same in groupby(merge(*readings, key=stamped), key=stamped):
        first_ns = first_ns or stamp_ns
        (group,) = by_stamp(same)
        heard = judge.heard([(reading, sensors[reading.sensor]) for reading in group], reckoned, lambda _: 1.0)
        for reading, sensor in heard:
            reckoned.update(reading, sensor)
        judge.fall = None
        if stamp_ns - looked_ns >= LOOK_NS:
            looked_ns, faults = stamp_ns, judge.problems.items()
            yield from (_finding(one, begun.pop(one), _since(first_ns, stamp_ns)) for one in [*begun.keys() - faults])
            begun |= {one: _since(first_ns, stamp_ns) for one in faults - begun.keys()}
    yield from (_finding(one, begin_s, _since(first_ns, stamp_ns)) for one, begin_s in begun.items())


def _since(first_ns: int, stamp_ns: int) -> float:
    return (stamp_ns - first_ns) * 1e-9


def _finding(fault: tuple[str, str], begin_s: float, end_s: float) -> Finding:
    name, (what, _, advice) = fault[0], fault[1].partition(": ")
    return Finding(Level.WARN, name, f"{what}, from {begin_s:.0f} to {end_s:.0f} s", advice)
