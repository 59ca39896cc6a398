"""New samples and final values on their way to the spool.

Each write costs a sync, so they are written together, and wait while the disk accepts nothing.
"""

import numpy as np

from agents.delivery.spool import Spool
from protocol.arrays import Table
from protocol.machine.samples import empty

MOST_UNSAVED = 100_000  # capacity in samples while the disk is full or fails


class WriteBuffer:
    """What is not on disk yet. given_up: samples dropped for lack of memory."""

    def __init__(self) -> None:
        self.given_up = 0
        self._new, self._final = empty(), 0  # new samples; the number of final ones
        self._finals = empty()  # final values of the oldest pending samples in the spool
        self._pending = 0  # samples in the spool still without a final value

    def __len__(self) -> int:
        return len(self._new)

    @property
    def is_clean(self) -> bool:
        """Whether everything is on disk."""
        return not len(self._new) and not len(self._finals)

    def add(self, pending: Table, finals: Table) -> None:
        """Add new samples, and final values of those pending longest, matched by order."""
        if not len(pending) and not len(finals):  # the usual case; concatenation copies all that waits
            return
        in_spool = min(len(finals), self._pending)
        self._finals = np.concatenate([self._finals, finals[:in_spool]])
        self._pending -= in_spool
        self._new, end = np.concatenate([self._new, pending]), self._final + len(finals) - in_spool
        self._new[self._final : end] = finals[in_spool:]
        self._final = end
        if (excess := min(len(self._new) - MOST_UNSAVED, self._final)) > 0:
            self._new, self._final, self.given_up = self._new[excess:], self._final - excess, self.given_up + excess

    def write(self, spool: Spool) -> int:
        """Write everything; returns the number of new samples. StoreError keeps all."""
        n, pending = len(self._new), len(self._new) - self._final
        spool.record(self._new, pending=pending, finals=self._finals)
        self._new, self._final, self._finals = empty(), 0, empty()
        self._pending += pending
        return n
