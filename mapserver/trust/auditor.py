"""The auditor: which machines contradict all others, why, and by what evidence.

All pairs of coarse maps are compared, and so are stamps at reception. A machine contradicts all others if machines that
agree among themselves outvote it, and it clearly differs from the map of those in good standing. Samples are compared
without corrections; a correction beyond the data sheet is a fault in itself. Exclusion is the caller's decision.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import exp, isfinite
from typing import Any

import numpy as np

from mapserver.calibration.select import MachineErrors
from mapserver.evidence.fold_config import FoldConfig, is_foldable
from mapserver.journal.rows import JournalRows
from mapserver.roads.worklist import litres
from mapserver.trust.coarse_map import CoarseMap, map_cell_m, pooled
from mapserver.trust.comparison import ComparedMap, Difference, compare, reverse
from mapserver.trust.judgement import (
    AGREE,
    DISAGREE,
    UNKNOWN,
    VOTED,
    ClockLeads,
    Judgement,
    Reason,
    beyond_data_sheet,
    faulty,
    judge,
    outvoted,
)
from mapserver.trust.tuning import TUNING, TrustTuning
from protocol.arrays import Ints, Table
from protocol.queries.roads import WorklistQuery

_PRINTED = {AGREE: "agrees_with", DISAGREE: "disagrees_with", UNKNOWN: "undecided_with"}

Pairs = dict[tuple[str, str], dict[Reason, Judgement]]  # of the first machine of each pair


@dataclass(frozen=True)
class Verdict:
    """The auditor's result for one machine.

    reasons: empty unless it contradicts all others. agrees: reasons in which it agrees. evidence: plain values, without
    what could not be compared: cells, gain, offset_east_m, offset_north_m, offset_std_m, agreement [-], spread,
    spread_of_others (of levels) against the pooled map of the others; clock_s: lead; zero, torque_gain, deviations and
    sources, from calibration; rolls, rolls_std, rolls_named, rolls_litres_ph: see `fleet.observability.Rolling`;
    excess: by reason, 1 at its limit; agrees_with, disagrees_with, undecided_with.
    """

    machine: str
    reasons: tuple[Reason, ...]
    evidence: Mapping[str, Any]
    contradicts: bool
    agrees: frozenset[Reason] = frozenset()


class Auditor:
    """Compares all machines of a site. cell_m: of the grid; fold: which samples know their place."""

    def __init__(self, cell_m: float, fold: FoldConfig | None = None, tuning: TrustTuning = TUNING) -> None:
        self._cell_m, self._tuning = cell_m, tuning
        self._fold = fold or FoldConfig()
        self._maps: dict[str, CoarseMap] = {}
        self._clocks = ClockLeads()
        self._mass_kg: dict[str, float] = {}  # last known

    def add(self, machine: str, rows: Table) -> None:
        """Add corrected samples of one machine, in the journal's order.

        Only clocks depend on order. The journal's shows what was sent at the same time better than times of receipt,
        which step with the server's clock.
        """
        if len(rows):
            self._add(machine, rows)
            self._clocks.add(machine, int(rows["stamp_ns"].max()))

    def add_all(self, rows: JournalRows) -> None:
        """Add journal rows of corrected samples."""
        machine = np.repeat(rows.machine, rows.lengths)
        for index, name in enumerate(rows.machines):
            self._add(name, rows.samples[machine == index])
        some = rows.lengths > 0
        starts = (np.cumsum(rows.lengths) - rows.lengths)[some]
        newest = np.maximum.reduceat(rows.samples["stamp_ns"], starts) if len(starts) else starts
        for index, stamp_ns in zip(rows.machine[some].tolist(), newest.tolist(), strict=True):
            self._clocks.add(rows.machines[index], stamp_ns)

    def _add(self, machine: str, rows: Table) -> None:
        if not len(rows):
            return
        if machine not in self._maps:
            self._maps[machine] = CoarseMap(self._cell_m)
        if len(known_kg := rows["mass_kg"][np.isfinite(rows["mass_kg"])]):
            self._mass_kg[machine] = float(known_kg.mean())
        sure = is_foldable(rows, self._fold)
        self._maps[machine].add(rows if sure.all() else rows[sure])

    def verdicts(self, states: Mapping[str, MachineErrors] | None = None) -> dict[str, Verdict]:
        """Judge every machine. states: of calibration, by name."""
        *_, verdicts = self.judging(states)
        return verdicts or {}

    def judging(self, states: Mapping[str, MachineErrors] | None = None) -> Iterator[dict[str, Verdict] | None]:
        """As `verdicts`, in steps, on the data at the first: None after each pair of machines, then all verdicts."""
        names = sorted(self._maps)
        surfaces = [self._maps[name].surface() for name in names]
        maps = [ComparedMap(surface, surface.places()) for surface in surfaces]
        pairs: Pairs = {}
        for (one, one_map), (other, other_map) in combinations(zip(names, maps, strict=True), 2):
            pairs |= self._pair(one, one_map, other, other_map)
            yield None
        votes = {reason: _votes(names, pairs, reason) for reason in VOTED}
        groups = {reason: outvoted(votes[reason]) for reason in VOTED}
        known = [(states or {}).get(name) for name in names]
        groups[Reason.BEYOND_DATA_SHEET] = faulty([beyond_data_sheet(state) for state in known])
        suspected = [any(groups[reason][i] for reason in Reason if reason != Reason.CLOCK) for i in range(len(names))]
        verdicts = {}
        for i, difference in enumerate(self._from_pool(maps, suspected)):
            judgements = judge(difference, self._tuning.verdict_sigmas, self._tuning)
            judgements[Reason.CLOCK], lead = self._clock(names, i, groups[Reason.CLOCK][i])
            judgements[Reason.BEYOND_DATA_SHEET] = beyond_data_sheet(known[i])
            reasons = tuple(r for r in Reason if groups[r][i] and judgements[r].state == DISAGREE)
            excess = {str(r): round(j.excess, 3) for r, j in judgements.items() if j.excess}
            calibrated = _calibrated(known[i], self._mass_kg.get(names[i], 0.0))
            evidence = _measured(difference) | lead | calibrated | {"excess": excess} | _sides(names, votes, i)
            agrees = frozenset(r for r, j in judgements.items() if j.state == AGREE)
            verdicts[names[i]] = Verdict(names[i], reasons, evidence, bool(reasons), agrees)
        yield verdicts

    def _pair(self, one: str, one_map: ComparedMap, other: str, other_map: ComparedMap) -> Pairs:
        sigmas, clocks = self._tuning.pair_sigmas, self._clocks
        difference = compare(one_map, other_map, map_cell_m(self._cell_m), self._tuning)
        back = reverse(difference) if difference else None
        there, here = (judge(each, sigmas, self._tuning) for each in (difference, back))
        return {
            (one, other): there | {Reason.CLOCK: clocks.compare(one, other)[1]},
            (other, one): here | {Reason.CLOCK: clocks.compare(other, one)[1]},
        }

    def _from_pool(self, maps: Sequence[ComparedMap], suspected: Sequence[bool]) -> Iterator[Difference | None]:
        """Differences from all others in good standing, pooled to have the most ground."""
        good = [each for each, bad in zip(maps, suspected, strict=True) if not bad]
        pool = ComparedMap(pooled([each.timed for each in good]), pooled([each.placed for each in good]))
        for own, bad in zip(maps, suspected, strict=True):
            rest = pool if bad else ComparedMap(pool.timed.without(own.timed), pool.placed.without(own.placed))
            yield compare(own, rest, map_cell_m(self._cell_m), self._tuning)

    def _clock(self, names: Sequence[str], i: int, group: Sequence[int]) -> tuple[Judgement, dict[str, Any]]:
        """Median lead over the outvoting machines, or over all others."""
        others = group or [j for j in range(len(names)) if j != i]
        leads = [self._clocks.compare(names[i], names[j]) for j in others]
        leads = [(lead, judgement) for lead, judgement in leads if isfinite(lead)]
        if not leads:
            return Judgement(), {}
        lead, judgement = sorted(leads, key=lambda each: each[0])[len(leads) // 2]
        return judgement, {"clock_s": round(lead, 1)}


def _votes(names: Sequence[str], pairs: Pairs, reason: Reason) -> Ints:
    states = np.full((len(names), len(names)), UNKNOWN, np.int64)
    for (one, other), judgements in pairs.items():
        states[names.index(one), names.index(other)] = judgements[reason].state
    return states


def _measured(difference: Difference | None) -> dict[str, Any]:
    """A comparison as plain values."""
    if difference is None:
        return {"cells": 0}
    shift = difference.shift
    values: dict[str, Any] = {"cells": difference.cells, "gain": exp(difference.gain.log)}
    if shift:
        values |= {"offset_east_m": shift.east_m, "offset_north_m": shift.north_m, "offset_std_m": shift.std_m}
    own, others = difference.spreads
    values |= {"agreement": difference.agreement, "spread": own, "spread_of_others": others}
    return {name: round(value, 3) for name, value in values.items()}


def _calibrated(state: MachineErrors | None, mass_kg: float) -> dict[str, Any]:
    """mass_kg: 0 if unknown."""
    if state is None:
        return {}
    values = {"zero": state.zero, "zero_std": state.zero_std}
    values |= {"torque_gain": 1 + state.scale, "torque_gain_std": state.scale_std}
    known_by: dict[str, Any] = {"zero_by": state.zero_by, "torque_gain_by": state.scale_by}
    if rolling := state.rolling:
        values |= {"rolls": rolling.share, "rolls_std": rolling.std}
        known_by |= {"rolls_named": rolling.is_named}
        if mass_kg:
            work_j = np.array(rolling.work_jpkgs * mass_kg * 3600.0)
            values["rolls_litres_ph"] = float(litres(work_j, WorklistQuery.efficiency))
    return {name: round(value, 5) for name, value in values.items()} | known_by


def _sides(names: Sequence[str], votes: Mapping[Reason, Ints], i: int) -> dict[str, Any]:
    """Disagrees: in anything; agrees: in all that is known."""
    rows = np.stack([of_reason[i] for of_reason in votes.values()])
    worst = np.where((rows == DISAGREE).any(axis=0), DISAGREE, rows.max(axis=0))
    others = [j for j in range(len(names)) if j != i]
    return {text: tuple(names[j] for j in others if worst[j] == state) for state, text in _PRINTED.items()}
