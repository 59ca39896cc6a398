"""The extended Kalman filter. x, P: belief, F: the motion's Jacobian, Q: its noise, L: lower factor of P."""

from __future__ import annotations

from dataclasses import dataclass

from agents.localisation.belief import Belief, Conditioned, Measurement, Motion
from agents.localisation.conditioning import bounded, conclude, definite, factor, is_usable, refused, wrapped_state


@dataclass(frozen=True)
class Ekf:
    """Linearises at the mean; exact where motion and measurement are linear."""

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        """Move the belief: x <- f(x), P <- F P F^T + Q, as the square of F L so that it is symmetric."""
        x = wrapped_state(motion.f(belief.x[None])[0], motion.angles)
        F_L = motion.jacobian(belief.x) @ factor(belief.P)
        return Belief(stamp_ns, x, definite(bounded(F_L @ F_L.T + motion.Q, motion.angles)))

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        """Condition the belief on a measurement; the prior unchanged where it is unusable or beyond its gate."""
        if not is_usable(measurement):
            return refused(belief, measurement)
        L = factor(belief.P)
        D = (measurement.jacobian(belief.x) @ L).T
        return conclude(belief, measurement, measurement.h(belief.x[None])[0], L, D, measurement.R)
