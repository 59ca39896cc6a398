"""What the spool hands to the uplink: its oldest samples."""

from dataclasses import dataclass

from protocol.arrays import Table


@dataclass(frozen=True)
class Head:
    """The oldest samples that are final, of one run. lost_before: how many directly before them will never be sent.

    Without rows it closes an earlier run: no more samples of it will come.
    newest: the last sequence number given out, of the run that is being recorded; None for an earlier run.
    """

    spool_id: int
    first_seq: int
    rows: Table
    lost_before: int
    newest: int | None = None

    @property
    def acknowledged(self) -> int:
        """The last sample before the rows that the server has confirmed."""
        return self.first_seq - 1 - self.lost_before
