"""What is known of one machine, and what of it is remembered once the evidence is gone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from mapserver.fleet.correction import ANY_SHARE, Correction
from mapserver.fleet.solver import SCALE_STD, ZERO_STD, Prior

SURE = 2.0  # standard deviations by which an estimate must be beyond a limit
# Of a scale that was observed once, and is not seen any more: temperature, tyres and oil change it by so much. Surer
# than what counts as observed, so that it counts until something contradicts it.
REMEMBERED_STD = 0.02


@dataclass(frozen=True)
class MachineState:
    """What is known of one machine: zero of its newest epoch, scale error k, lateral zero, and standard deviations.

    zero_by, scale_by: the sources that show them, none where the data sheet has to do; the scale is 0 then. beyond:
    how many standard deviations of the data sheet the largest zero and the scale are off, for sure.
    """

    zero: float
    zero_std: float
    scale: float
    scale_std: float
    across: float
    across_std: float
    zero_by: tuple[str, ...]
    scale_by: tuple[str, ...]
    beyond: tuple[float, float]


def is_surer(prior: Prior, state: MachineState | None) -> bool:
    """Whether what is remembered of a scale is surer than what a solve without it says."""
    return state is not None and state.scale_std**2 > prior.covariance[1][1]


def remembered_of(shown: Iterable[Correction]) -> dict[str, Prior]:
    """What evidence showed of scales, by the last correction of each machine. A zero wanders, and is not remembered."""
    out = {}
    for one in shown:
        if one.most_share >= ANY_SHARE and one.covariance:
            state = state_of(one)
            variance = max(state.scale_std, REMEMBERED_STD) ** 2
            out[one.machine] = Prior(0.0, state.scale, ((ZERO_STD**2, 0.0), (0.0, variance)))
    return out


def state_of(correction: Correction) -> MachineState:
    """What a correction by the solver says of its machine, where nothing has been solved yet."""
    k = correction.scale / (1 - correction.scale)
    zero_std, scale_std, across_std = np.sqrt(np.diag(correction.covariance)).tolist()
    return MachineState(
        zero=correction.zero,
        zero_std=zero_std,
        scale=k,
        scale_std=scale_std,
        across=correction.across,
        across_std=across_std,
        zero_by=(),
        scale_by=(),
        beyond=(
            max(abs(correction.zero) - SURE * zero_std, 0.0) / ZERO_STD,
            max(abs(k) - SURE * scale_std, 0.0) / SCALE_STD,
        ),
    )
