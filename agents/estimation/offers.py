"""Calibration offers of the map server: one more estimate, never the truth.

An offer comes from this machine's samples, so it depends on the same readings as the own estimate, to an unknown
degree. Covariance intersection (Julier and Uhlmann 1997) is consistent in any case, and an offer repeated adds nothing:

    P^-1 = w A^-1 + (1 - w) B^-1        P^-1 x = w A^-1 a + (1 - w) B^-1 b

with w in 0 to 1 that minimises det P.
"""

from collections import Counter
from typing import Any

import numpy as np

from protocol.arrays import Floats
from protocol.errors import MessageError
from protocol.units import HOUR_NS
from protocol.wire.codec import decode_offer
from protocol.wire.messages import CalibrationOffer

TOO_OLD_NS = HOUR_NS  # by then a bias has drifted by its initial deviation
AHEAD_NS = 600 * 10**9  # largest lead over the machine's clock, longer than the server's decision interval
WEIGHTS = np.linspace(0.0, 1.0, 101)


class Offers:
    """Judges offers to one machine; the newest good one waits. counters: refusals by reason."""

    def __init__(self, machine: str, newest_ns: int) -> None:
        """newest_ns: stamp of the last offer taken, or 0."""
        self.counters: Counter[str] = Counter()
        self._machine, self._newest_ns = machine, newest_ns
        self._waiting: CalibrationOffer | None = None

    def consider(self, table: Any, now_ns: int) -> None:
        """Judge an undecoded offer; now_ns: the machine's."""
        try:
            offer = decode_offer(table)
        except MessageError as error:
            self.counters[f"refused_offer_{error.reason}"] += 1
            return
        if problem := self._problem(offer, now_ns):
            self.counters[f"refused_offer_{problem}"] += 1
        elif offer.stamp_ns > self._newest_ns:  # else a repetition: it comes with each acknowledgement
            self._newest_ns, self._waiting = offer.stamp_ns, offer

    def take(self) -> CalibrationOffer | None:
        """The waiting offer, once."""
        offer, self._waiting = self._waiting, None
        return offer

    def _problem(self, offer: CalibrationOffer, now_ns: int) -> str:
        if offer.machine != self._machine:
            return "wrong_machine"
        if offer.stamp_ns < self._newest_ns:
            return "not_newer"
        if offer.stamp_ns > now_ns + AHEAD_NS:
            return "in_future"
        return "too_old" if offer.stamp_ns < now_ns - TOO_OLD_NS else ""


def intersected(a: Floats, A: Floats, b: Floats, B: Floats) -> tuple[Floats, Floats]:
    """Mean (n,) and covariance (n, n) of two estimates of unknown correlation."""
    of_a, of_b = np.linalg.inv(A), np.linalg.inv(B)
    information = WEIGHTS[:, None, None] * of_a + (1 - WEIGHTS[:, None, None]) * of_b
    best = int(np.argmax(np.linalg.det(information)))
    w, P = float(WEIGHTS[best]), np.linalg.inv(information[best])
    x = P @ (w * of_a @ a + (1 - w) * of_b @ b)
    return np.asarray(x, np.float64), np.asarray((P + P.T) / 2, np.float64)
