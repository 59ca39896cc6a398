"""Who is outvoted: from what each pair of machines says about each other to the machines that contradict all others."""

from __future__ import annotations

from protocol.arrays import Ints

AGREE, UNKNOWN, DISAGREE = 1, 0, -1


def outvoted(states: Ints) -> list[tuple[int, ...]]:
    """For each machine the group of others by which it is outvoted; empty where it is not.

    states: (n, n) AGREE, UNKNOWN or DISAGREE of row's machine with column's.
    A machine is outvoted by a group of at least two that it disagrees with, and that agree among themselves, if the
    group is larger than the machine's own side, and at least half of all that can be compared with it: of two machines
    nobody knows which is right, nor when most of a fleet is wrong.
    """
    return [_outvoters(states, machine) for machine in range(len(states))]


def _outvoters(states: Ints, machine: int) -> tuple[int, ...]:
    against = [int(other) for other in (states[machine] == DISAGREE).nonzero()[0]]
    side = 1 + int((states[machine] == AGREE).sum())
    group = max((_group(states, seed, against) for seed in against), key=len, default=())
    decides = len(group) >= 2 and len(group) > side and 2 * len(group) >= len(against) + side
    return group if decides else ()


def _group(states: Ints, seed: int, candidates: list[int]) -> tuple[int, ...]:
    """The seed and those who agree with it, without those who disagree with one already in."""
    group = [seed]
    for other in candidates:
        if states[seed, other] == AGREE and all(states[other, member] != DISAGREE for member in group):
            group.append(other)
    return tuple(sorted(group))
