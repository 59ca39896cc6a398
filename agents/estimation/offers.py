"""What the map server offers for a calibration: one estimate more, and never the truth.

It is made of samples of this machine, and so of the readings that the machine's own estimate is made of. How far the
two depend on each other nobody knows. Covariance intersection (Julier and Uhlmann 1997) is consistent whatever that is:

    P^-1 = w A^-1 + (1 - w) B^-1        P^-1 x = w A^-1 a + (1 - w) B^-1 b

with the weight w in 0 to 1 for which det P is least. So what is offered twice shows nothing new.
"""

from collections import Counter
from typing import Any

import numpy as np

from protocol.arrays import Floats
from protocol.errors import MessageError
from protocol.units import HOUR_NS
from protocol.wire.codec import decode_offer
from protocol.wire.messages import CalibrationOffer

TOO_OLD_NS = HOUR_NS  # by then a zero has moved by as much as it is unsure at first
AHEAD_NS = 600 * 10**9  # of the machine's clock: others may be ahead of it, but not by more than the server decides in
WEIGHTS = np.linspace(0.0, 1.0, 101)


class Offers:
    """Judges what is offered to one machine. counters: what was refused, by reason.

    The newest good offer waits until the machine is ready for it.
    """

    def __init__(self, machine: str, newest_ns: int) -> None:
        """newest_ns: stamp of the last offer that was taken before, 0 for none."""
        self.counters: Counter[str] = Counter()
        self._machine, self._newest_ns = machine, newest_ns
        self._waiting: CalibrationOffer | None = None

    def consider(self, table: Any, now_ns: int) -> None:
        """Judge an offer as it came. now_ns: the machine's."""
        try:
            offer = decode_offer(table)
        except MessageError as error:
            self.counters[f"refused_offer_{error.reason}"] += 1
            return
        if problem := self._problem(offer, now_ns):
            self.counters[f"refused_offer_{problem}"] += 1
        elif offer.stamp_ns > self._newest_ns:  # else it is the last one: it comes with each acknowledgement
            self._newest_ns, self._waiting = offer.stamp_ns, offer

    def take(self) -> CalibrationOffer | None:
        """The offer that waits, once."""
        offer, self._waiting = self._waiting, None
        return offer

    def _problem(self, offer: CalibrationOffer, now_ns: int) -> str:
        """Why it is not for this machine now, "" if it is."""
        if offer.machine != self._machine:
            return "wrong_machine"
        if offer.stamp_ns < self._newest_ns:
            return "not_newer"
        if offer.stamp_ns > now_ns + AHEAD_NS:
            return "in_future"
        return "too_old" if offer.stamp_ns < now_ns - TOO_OLD_NS else ""


def intersected(a: Floats, A: Floats, b: Floats, B: Floats) -> tuple[Floats, Floats]:
    """Mean (n,) and covariance (n, n) of two estimates that may depend on each other in any way."""
    of_a, of_b = np.linalg.inv(A), np.linalg.inv(B)
    information = WEIGHTS[:, None, None] * of_a + (1 - WEIGHTS[:, None, None]) * of_b
    best = int(np.argmax(np.linalg.det(information)))
    w, P = float(WEIGHTS[best]), np.linalg.inv(information[best])
    x = P @ (w * of_a @ a + (1 - w) * of_b @ b)
    return np.asarray(x, np.float64), np.asarray((P + P.T) / 2, np.float64)
