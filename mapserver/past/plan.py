"""Which checkpoints there should be: at the full hours of the site's last day, then one a day, thinned by age.

Pure functions of times: stamps and closing times [ns since 1970]. The site's now is its newest stamp, so that logs that
are replayed, at any speed, get theirs too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from protocol.units import DAY_NS, HOUR_NS

GRACE_NS = 300 * 10**9  # after an hour's end, most of what machines still had of it has come in


def due(
    now_ns: int, usable: Sequence[int], unusable: Sequence[int], next_stamp: Callable[[int], int | None]
) -> int | None:
    """When the checkpoint to be made next is closed; None where all are there.

    usable, unusable: closing times of those that there are; one that cannot be used is made again. next_stamp: the
    least stamp from a time on, so that none is made for hours or days without samples. Whoever is slower than a
    replayed log skips hours.
    """
    if again := [closed_ns for closed_ns in unusable if closed_ns + GRACE_NS <= now_ns]:
        return min(again)
    if (stamp_ns := next_stamp(max(usable, default=0))) is None:
        return None
    first_hour_ns = (now_ns - DAY_NS) // HOUR_NS * HOUR_NS  # of the last day
    closed_ns = max(_end(stamp_ns, HOUR_NS), min(_end(stamp_ns, DAY_NS), first_hour_ns))
    return closed_ns if closed_ns + GRACE_NS <= now_ns else None


def surplus(now_ns: int, closed: Sequence[int]) -> list[int]:
    """Those of the closing times that nobody needs: of hours that went by a day ago all but the last one of each day.

    Also those in the future, which were closed when a machine's clock was wrong.
    """
    last_of_day = {_end(closed_ns - 1, DAY_NS): closed_ns for closed_ns in sorted(closed)}
    old = [each for each in closed if each <= now_ns - DAY_NS]
    future = [each for each in closed if each > now_ns]
    return [each for each in old if each != last_of_day[_end(each - 1, DAY_NS)]] + future


def thinned(begin_ns: int, now_ns: int, sizes: Mapping[int, int], most_bytes: int) -> list[int]:
    """Closing times to do without, so that the others take at most so many bytes.

    begin_ns: the first stamp of all. sizes: bytes by closing time. The one goes first without which a map has least to
    fold in proportion to its age, so that steps grow with age; the newest goes last.
    """
    kept, gone = sorted(sizes), list[int]()
    while kept and sum(sizes[each] for each in kept) > most_bytes:
        gone.append(kept.pop(_least_missed(begin_ns, now_ns, kept)))
    return gone


def _least_missed(begin_ns: int, now_ns: int, kept: Sequence[int]) -> int:
    """Index of the one that is missed least; never the newest of several."""
    before = [begin_ns, *kept]
    steps = [(after - before[i]) / max(now_ns - kept[i], HOUR_NS) for i, after in enumerate(kept[1:])]
    return steps.index(min(steps)) if steps else 0


def _end(stamp_ns: int, span_ns: int) -> int:
    """End of the span that a stamp lies in."""
    return (stamp_ns // span_ns + 1) * span_ns
