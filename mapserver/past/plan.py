"""Which checkpoints should exist: hourly for the last day, then daily, thinned with age.

Pure functions of stamps and closing times [ns since 1970]. The site's now is its newest stamp, so replayed logs work at
any speed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from protocol.units import DAY_NS, HOUR_NS

GRACE_NS = 300 * 10**9  # wait after an hour's end for samples still on machines


def due(
    now_ns: int, usable: Sequence[int], unusable: Sequence[int], next_stamp: Callable[[int], int | None]
) -> int | None:
    """Closing time of the next checkpoint, or None.

    usable, unusable: closing times of existing ones; unusable are made again. next_stamp: least stamp since a time, to
    skip times without samples. Slower than a replayed log, hours are skipped.
    """
    if again := [closed_ns for closed_ns in unusable if closed_ns + GRACE_NS <= now_ns]:
        return min(again)
    if (stamp_ns := next_stamp(max(usable, default=0))) is None:
        return None
    first_hour_ns = (now_ns - DAY_NS) // HOUR_NS * HOUR_NS  # of the last day
    closed_ns = max(_end(stamp_ns, HOUR_NS), min(_end(stamp_ns, DAY_NS), first_hour_ns))
    return closed_ns if closed_ns + GRACE_NS <= now_ns else None


def surplus(now_ns: int, closed: Sequence[int]) -> list[int]:
    """Closing times not needed: those older than a day, but for each day's last one.

    Also future ones, closed by a wrong clock.
    """
    last_of_day = {_end(closed_ns - 1, DAY_NS): closed_ns for closed_ns in sorted(closed)}
    old = [each for each in closed if each <= now_ns - DAY_NS]
    future = [each for each in closed if each > now_ns]
    return [each for each in old if each != last_of_day[_end(each - 1, DAY_NS)]] + future


def thinned(begin_ns: int, now_ns: int, sizes: Mapping[int, int], most_bytes: int) -> list[int]:
    """Closing times to drop, so that the rest fits into most_bytes.

    begin_ns: first stamp of all. sizes: bytes by closing time. The least additional folding relative to age goes first,
    so steps grow with age; the newest goes last.
    """
    kept, gone = sorted(sizes), list[int]()
    while kept and sum(sizes[each] for each in kept) > most_bytes:
        gone.append(kept.pop(_least_missed(begin_ns, now_ns, kept)))
    return gone


def _least_missed(begin_ns: int, now_ns: int, kept: Sequence[int]) -> int:
    """Index of the least missed; never the newest of several."""
    before = [begin_ns, *kept]
    steps = [(after - before[i]) / max(now_ns - kept[i], HOUR_NS) for i, after in enumerate(kept[1:])]
    return steps.index(min(steps)) if steps else 0


def _end(stamp_ns: int, span_ns: int) -> int:
    return (stamp_ns // span_ns + 1) * span_ns
