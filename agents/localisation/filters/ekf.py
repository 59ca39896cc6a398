"""The extended Kalman filter. x, P: belief, F: motion Jacobian, Q: its noise, L: lower factor of P."""

from dataclasses import dataclass

import numpy as np

from agents.localisation.filters.belief import Belief, Conditioned, Measurement, Motion
from agents.localisation.filters.square_root import conclude, conclude_motion, noise_root, refused, root


@dataclass(frozen=True)
class Ekf:
    """Linearises at the mean; exact for linear models."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Predict: x <- f(x), P <- F P F^T + Q, as the square of F L for symmetry."""
        F = motion.jacobian(belief.x)
        F_L = F.dot(root(belief))
        return conclude_motion(belief, motion, stamp_ns, motion.f(belief.x[None])[0], F_L.dot(F_L.T) + motion.Q, F)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition; the prior if unusable or gated."""
        noise = noise_root(measurement)
        if noise is None:
            return refused(belief, measurement)
        L, H, (n, k) = root(belief), measurement.jacobian(belief.x), (len(belief.x), len(noise))
        together = np.zeros((k + n, n + k))
        together[:k, :n], together[:k, n:] = H.dot(L), noise
        together[k:, :n] = L
        return conclude(belief, measurement, measurement.h(belief.x[None])[0], together, H)
