"""Which place is right, before or after a jump while the wheels run on.

A receiver that is switched, spoofed or leaves a tunnel jumps, and may jump back; one always off jumps to the right
place. If fixes return, the place before was right and those between wrong. If they stay three times as long as they had
stood before, within bounds, they are right and earlier places doubtful. Longer errors look like truth.
"""

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from protocol.arrays import Floats

JUMP_M = 8.0  # smallest jump beyond usual receiver errors
CLEAR_S, MOST_CLEAR_S = 60.0, 600.0  # time to clear: longer than echoes and receiver switches, yet bounded for the map
TIMES = 3.0  # over the time for the place before; equal would be a toss-up
OUTAGE_S = 10.0  # time without fixes, after which drifting dead reckoning stands alone
MARGIN_NS = 3 * 10**9  # around a jump: it creeps at first, and settles later
BACK = 0.25  # share of the jump that counts as returned


@dataclass
class PlaceWatch:
    """Whether the position is clear. counters: of jumps. problem: a sentence by receiver while it is not."""

    counters: Counter[str] = field(default_factory=Counter)
    problem: dict[str, str] = field(default_factory=dict)
    _since_ns: int = 0
    _newest_ns: int = 0  # stamp of the last jump
    _taken_ns: int = 0  # stamp of the last accepted fix
    _stood_s: float = 0.0  # how long fixes have supported the current place
    _needed_s: float = 0.0  # required time after a jump
    _off_m: Floats = field(default_factory=lambda: np.zeros(2))  # from the place before the first jump
    _furthest_m: float = 0.0
    _spans: list[tuple[int, int, float]] = field(default_factory=list)  # begin, end, error of doubtful places

    @property
    def is_clear(self) -> bool:
        """Whether nothing is in doubt now."""
        return not self.problem

    def jumped(self, receiver: str, since_ns: int, now_ns: int, off_m: Floats) -> None:
        """Note a relock on fixes off by off_m (2,) since since_ns."""
        if self.is_clear:
            if np.hypot(*off_m) < JUMP_M:
                return
            self._since_ns, self._off_m, self._furthest_m = since_ns - MARGIN_NS, np.zeros(2), 0.0
            self._needed_s = min(max(TIMES * self._stood_s, CLEAR_S), MOST_CLEAR_S)
        self.counters["place_jumps"] += 1
        self._newest_ns, self._stood_s, self._off_m = now_ns, 0.0, self._off_m + off_m
        self._furthest_m = max(self._furthest_m, far_m := float(np.hypot(*self._off_m)))
        if far_m < max(JUMP_M, BACK * self._furthest_m):
            self.counters["place_jumps_back"] += 1
            self._stood_s = self._needed_s / TIMES
            self._end(self._since_ns, now_ns + MARGIN_NS)
        else:
            why = "while the wheels ran on: samples are withheld until it is clear which place is right"
            self.problem = {receiver: f"jumped {far_m:.0f} m {why}"}

    def look(self, now_ns: int) -> None:
        """Note an accepted fix; a lasting place is believed."""
        passed_s, self._taken_ns = (now_ns - self._taken_ns) * 1e-9, max(now_ns, self._taken_ns)
        if 0 < passed_s < OUTAGE_S:
            self._stood_s += passed_s
        elif passed_s > 0 and self.is_clear:
            self._stood_s = 0.0
        if not self.is_clear and self._stood_s >= self._needed_s:
            self._end(0, self._newest_ns + MARGIN_NS)

    def off_m(self, stamp_ns: int) -> float:
        """Possible error of a place, beyond the filter's."""
        if not self.is_clear:
            return self._furthest_m
        return max((far_m for from_ns, to_ns, far_m in self._spans if from_ns <= stamp_ns <= to_ns), default=0.0)

    def _end(self, from_ns: int, to_ns: int) -> None:
        self.problem = {}
        self._spans = [*self._spans[-1:], (from_ns, to_ns, self._furthest_m)]
