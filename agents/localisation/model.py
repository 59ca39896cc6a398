"""The planar model: pose driven by wheel travel and turn, with the errors of both and of each GPS receiver as states.

EVIDENCE: GPS errors are slow. Taken as white they average to a wrong confidence; a Gauss-Markov error per receiver in
the state pays only together with gyro bias and wheel scale, and with honest slip noise. Heading is not wrapped inside.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from protocol.arrays import Floats

POSITION = slice(0, 2)
HEADING = 2
GYRO_BIAS = 3
WHEEL_SCALE = 4
BASE_STATES = 5  # followed by two per GPS receiver: its error east and north


@dataclass(frozen=True)
class ModelConfig:
    """Noise of the model.

    slip_m2_per_s: position variance that side slip and the like add per second of driving. turn_noise: heading random
    walk [rad/sqrt(s)]. travel_share: standard deviation of wheel travel over the square root of the way [sqrt(m)].
    slip, slip_std: wheel slip per traction (drive force over weight), what is taken off and how unsure that is;
    slip_time_s: how long a ground's slip stays the same.
    gyro_bias_radps, wheel_scale: standard deviations at start; *_walk: their random walks per sqrt(s).
    """

    slip_m2_per_s: float = 2e-3
    turn_noise: float = 2e-3
    travel_share: float = 0.02
    slip: float = 0.2
    slip_std: float = 0.15
    slip_time_s: float = 5.0
    gyro_bias_radps: float = 5e-3
    gyro_bias_walk: float = 5e-5
    wheel_scale: float = 0.03
    wheel_scale_walk: float = 2e-4

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            if getattr(self, name) <= 0:
                raise ValueError(f"{name}: must be positive")


@dataclass(frozen=True)
class Step:
    """What wheels and gyro say of one time step: travel [m], turn [rad], duration [s].

    pull: integral of (traction x speed)^2 over the step [m2/s], to which slip's uncertainty is proportional.
    """

    travel_m: float
    turn_rad: float
    dt_s: float
    pull: float = 0.0


def drift_states(receiver: int) -> slice:
    """States of the error of one GPS receiver."""
    return slice(BASE_STATES + 2 * receiver, BASE_STATES + 2 * receiver + 2)


def move(sigmas: Floats, step: Step, decay: Floats) -> Floats:
    """Move states (m, n) by one step; decay (receivers,) is how much of each GPS error remains."""
    out = sigmas.copy()
    turn = step.turn_rad - sigmas[:, GYRO_BIAS] * step.dt_s
    travel = step.travel_m / (1 + sigmas[:, WHEEL_SCALE])
    middle = sigmas[:, HEADING] + turn / 2
    out[:, 0] += travel * np.cos(middle)
    out[:, 1] += travel * np.sin(middle)
    out[:, HEADING] += turn
    out[:, BASE_STATES:] *= np.repeat(decay, 2)
    return out


def process_noise(step: Step, heading: float, decay: Floats, drift_var_m2: Floats, config: ModelConfig) -> Floats:
    """Process noise Q (n, n) of one step; the drift's is exact for a stationary Gauss-Markov process."""
    n = BASE_STATES + 2 * len(decay)
    Q = np.zeros((n, n))
    way = abs(step.travel_m)
    along = np.array([np.cos(heading), np.sin(heading)])
    moving = min(1.0, way / max(step.dt_s, 1e-9))  # a machine at rest does not slip
    slip_m2 = config.slip_std**2 * 2 * config.slip_time_s * step.pull
    Q[POSITION, POSITION] = np.outer(along, along) * (config.travel_share**2 * way + slip_m2)
    Q[POSITION, POSITION] += np.eye(2) * config.slip_m2_per_s * step.dt_s * moving
    Q[HEADING, HEADING] = config.turn_noise**2 * step.dt_s
    Q[GYRO_BIAS, GYRO_BIAS] = config.gyro_bias_walk**2 * step.dt_s
    Q[WHEEL_SCALE, WHEEL_SCALE] = config.wheel_scale_walk**2 * step.dt_s
    drift = np.arange(BASE_STATES, n)
    Q[drift, drift] = np.repeat(drift_var_m2 * (1 - decay**2), 2)
    return Q


def antenna(sigmas: Floats, lever_m: tuple[float, float], receiver: int) -> Floats:
    """Fix (m, 2) that a receiver would report: antenna position plus the receiver's error."""
    c, s = np.cos(sigmas[:, HEADING]), np.sin(sigmas[:, HEADING])
    arm = np.stack([c * lever_m[0] - s * lever_m[1], s * lever_m[0] + c * lever_m[1]], axis=1)
    return sigmas[:, POSITION] + arm + sigmas[:, drift_states(receiver)]
