"""The extended Kalman filter. x, P: belief, F: the motion's Jacobian, Q: its noise, L: lower factor of P."""

from dataclasses import dataclass

import numpy as np

from agents.localisation.filters.belief import Belief, Conditioned, Measurement, Motion
from agents.localisation.filters.square_root import (
    bounded,
    conclude,
    definite,
    noise_root,
    refused,
    root,
    wrapped_state,
)


@dataclass(frozen=True)
class Ekf:
    """Linearises at the mean; exact where motion and measurement are linear."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief: x <- f(x), P <- F P F^T + Q, as the square of F L so that it is symmetric."""
        x = wrapped_state(motion.f(belief.x[None])[0], motion.angles)
        F_L = motion.jacobian(belief.x).dot(root(belief))
        return definite(stamp_ns, x, bounded(F_L.dot(F_L.T) + motion.Q, motion.angles))

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement; the prior unchanged where it is unusable or beyond its gate."""
        noise = noise_root(measurement)
        if noise is None:
            return refused(belief, measurement)
        L, (n, k) = root(belief), (len(belief.x), len(noise))
        together = np.zeros((k + n, n + k))
        together[:k, :n], together[:k, n:] = measurement.jacobian(belief.x).dot(L), noise
        together[k:, :n] = L
        return conclude(belief, measurement, measurement.h(belief.x[None])[0], together)
