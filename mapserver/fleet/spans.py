"""Corrections of one machine in the order of time: what covers what, and what lies at a time."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace

from mapserver.fleet.correction import Correction

VALUES = ("zero", "scale", "across", "most_share")


def values(one: Correction) -> tuple[float, ...]:
    """What a correction does to a sample, by VALUES."""
    return one.zero, one.scale, one.across, one.most_share


def paint(spans: list[Correction], one: Correction) -> None:
    """Put a correction over those of one machine, which are in order of time; what it covers of them goes.

    Neighbours that do the same become one, as sure as the later: else they would grow without an end.
    """
    first = bisect_right(spans, one.from_ns, key=lambda other: other.to_ns)
    end = first
    while end < len(spans) and spans[end].from_ns < one.to_ns:
        end += 1
    left = [replace(other, to_ns=one.from_ns) for other in spans[first:end] if other.from_ns < one.from_ns]
    right = [replace(other, from_ns=one.to_ns) for other in spans[first:end] if other.to_ns > one.to_ns]
    before, after = spans[max(first - 1, 0) : first], spans[end : end + 1]
    joined: list[Correction] = []
    for each in [*before, *left, one, *right, *after]:
        if joined and joined[-1].to_ns == each.from_ns and values(joined[-1]) == values(each):
            joined[-1] = replace(each, from_ns=joined[-1].from_ns)
        else:
            joined.append(each)
    spans[first - len(before) : end + len(after)] = joined


def at(spans: Sequence[Correction], stamp_ns: int) -> Correction | None:
    """The correction that a time has, of those of one machine in order of time."""
    index = bisect_right(spans, stamp_ns, key=lambda one: one.from_ns) - 1
    return spans[index] if index >= 0 and stamp_ns < spans[index].to_ns else None
