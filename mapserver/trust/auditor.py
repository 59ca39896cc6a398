"""Trust: which machines contradict all others, why, and by what evidence.

Each machine has a coarse map of its own (coarse_map.py). All pairs of maps are compared (comparison.py), and so are the
stamps at reception. A machine contradicts all others where it is outvoted by machines that agree among themselves, and
where its difference from the map of all that are in good standing is beyond doubt (judgement.py). Compared are samples
without what calibration takes off; what it takes off is a fault of its own where no data sheet allows it, as a torque
that reads half as much again. Whether and when to exclude a machine is the caller's decision.
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

Pairs = dict[tuple[str, str], dict[Reason, Judgement]]  # of the first of two machines


@dataclass(frozen=True)
class Verdict:
    """What is known of one machine.

    reasons: empty unless it contradicts all others. agrees: in what it is seen to agree with them. evidence: plain
    values; what could not be compared is missing. cells, gain, offset_east_m, offset_north_m, offset_std_m,
    agreement [-], spread and spread_of_others (of the levels) against the map of all others in good standing; clock_s:
    ahead of the others; zero, torque_gain, their standard deviations and what shows them: of the calibration; rolls,
    rolls_std, rolls_named, rolls_litres_ph: see `fleet.observability.Rolling`, of driving; excess: by reason, 1 at its
    limit; agrees_with, disagrees_with, undecided_with: machines.
    """

    machine: str
    reasons: tuple[Reason, ...]
    evidence: Mapping[str, Any]
    contradicts: bool
    agrees: frozenset[Reason] = frozenset()


class Auditor:
    """Compares all machines of one site. cell_m: of the site's grid; fold: which samples know their place."""

    def __init__(self, cell_m: float, fold: FoldConfig | None = None, tuning: TrustTuning = TUNING) -> None:
        self._cell_m, self._tuning = cell_m, tuning
        self._fold = fold or FoldConfig()
        self._maps: dict[str, CoarseMap] = {}
        self._clocks = ClockLeads()
        self._mass_kg: dict[str, float] = {}  # as last known

    def add(self, machine: str, rows: Table) -> None:
        """Add samples of one machine, corrected; in the order of the journal.

        The maps depend on no order. The clocks do: compared is what the machines sent at about the same time, and the
        order of the journal shows that better than the time of receipt, which steps where the server's clock is set.
        """
        if len(rows):
            self._add(machine, rows)
            self._clocks.add(machine, int(rows["stamp_ns"].max()))

    def add_all(self, rows: JournalRows) -> None:
        """Add many journal rows at once, as one by one. Their samples are corrected."""
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
        """Judge every machine. states: what calibration knows of them, by name."""
        *_, verdicts = self.judging(states)
        return verdicts or {}

    def judging(self, states: Mapping[str, MachineErrors] | None = None) -> Iterator[dict[str, Verdict] | None]:
        """As `verdicts`, of what there is at the first step: None after each pair of machines, then all."""
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
        """Judge two machines against each other."""
        sigmas, clocks = self._tuning.pair_sigmas, self._clocks
        difference = compare(one_map, other_map, map_cell_m(self._cell_m), self._tuning)
        back = reverse(difference) if difference else None
        there, here = (judge(each, sigmas, self._tuning) for each in (difference, back))
        return {
            (one, other): there | {Reason.CLOCK: clocks.compare(one, other)[1]},
            (other, one): here | {Reason.CLOCK: clocks.compare(other, one)[1]},
        }

    def _from_pool(self, maps: Sequence[ComparedMap], suspected: Sequence[bool]) -> Iterator[Difference | None]:
        """Differences of each machine from all others in good standing together: more ground than any one has."""
        good = [each for each, bad in zip(maps, suspected, strict=True) if not bad]
        pool = ComparedMap(pooled([each.timed for each in good]), pooled([each.placed for each in good]))
        for own, bad in zip(maps, suspected, strict=True):
            rest = pool if bad else ComparedMap(pool.timed.without(own.timed), pool.placed.without(own.placed))
            yield compare(own, rest, map_cell_m(self._cell_m), self._tuning)

    def _clock(self, names: Sequence[str], i: int, group: Sequence[int]) -> tuple[Judgement, dict[str, Any]]:
        """Typical lead over the machines that outvote this one, or else over all others."""
        others = group or [j for j in range(len(names)) if j != i]
        leads = [self._clocks.compare(names[i], names[j]) for j in others]
        leads = [(lead, judgement) for lead, judgement in leads if isfinite(lead)]
        if not leads:
            return Judgement(), {}
        lead, judgement = sorted(leads, key=lambda each: each[0])[len(leads) // 2]
        return judgement, {"clock_s": round(lead, 1)}


def _votes(names: Sequence[str], pairs: Pairs, reason: Reason) -> Ints:
    """Matrix of AGREE, UNKNOWN, DISAGREE for one reason."""
    states = np.full((len(names), len(names)), UNKNOWN, np.int64)
    for (one, other), judgements in pairs.items():
        states[names.index(one), names.index(other)] = judgements[reason].state
    return states


def _measured(difference: Difference | None) -> dict[str, Any]:
    """A comparison in plain values."""
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
    """What calibration knows of a machine, in plain values. mass_kg: 0 where it is not known."""
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
    """Whom it disagrees with in anything, agrees with in all that is known, and cannot be compared with."""
    rows = np.stack([of_reason[i] for of_reason in votes.values()])
    worst = np.where((rows == DISAGREE).any(axis=0), DISAGREE, rows.max(axis=0))
    others = [j for j in range(len(names)) if j != i]
    return {text: tuple(names[j] for j in others if worst[j] == state) for state, text in _PRINTED.items()}
