"""What may enter the journal: the rules of identity, as a pure function."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace

from mapserver.journal.rows import Admission, StoreIdentity
from protocol.errors import MessageError, Refusal
from protocol.site.site_config import SiteConfig
from protocol.wire.messages import SampleBatch


class GapError(MessageError):
    """A batch starts beyond the next sample that the server expects, and does not say that those before are lost."""

    def __init__(self, first_seq: int, expected: int) -> None:
        problem = f"{first_seq}: sample {expected} is expected next; send from there, or say lost_before"
        super().__init__(Refusal.GAP, problem, field="first_seq")
        self.expected = expected


def judge(batch: SampleBatch, machine: str, site: SiteConfig, now_ns: Callable[[], int]) -> None:
    """Judge a decoded batch that came in under the key of `machine`; MessageError says what is wrong with it."""
    if batch.machine != machine:
        problem = f"{batch.machine!r} sends under the key of {machine!r}"
        raise MessageError(Refusal.WRONG_MACHINE, problem, field="machine")
    if batch.frame != site.frame:
        problem = f"{batch.frame[:16]!r}: the frame of site {site.name} is {site.frame!r}; compare the site files"
        raise MessageError(Refusal.WRONG_FRAME, problem, field="frame")
    if site.clock == "wall" and len(batch.rows):
        row = int(batch.rows["stamp_ns"].argmax())
        ahead_s = (int(batch.rows["stamp_ns"][row]) - now_ns()) * 1e-9
        if ahead_s > site.clock_tolerance_s:
            problem = f"{ahead_s:.1f} s ahead of the server's clock; set the machine's clock"
            raise MessageError(Refusal.WALL_CLOCK, problem, field="stamp_ns", row=row)


def check_store(batch: SampleBatch, identity: StoreIdentity, accepted: Collection[str]) -> str:
    """The store that this one replaces for a batch, empty where it need not; MessageError where it may not.

    accepted: ids of the stores whose place a person has let this one take.
    """
    if batch.store in ("", identity.id):
        return ""
    if batch.store in identity.descends or batch.store in accepted:
        return batch.store
    problem = f"earlier samples of this run are in store {batch.store}, and this is store {identity.id}: start the"
    problem += f" server with that one, or `sitegrid accept {batch.store}` if it is gone"
    raise MessageError(Refusal.OTHER_STORE, problem, field="store")


def admit(batch: SampleBatch, watermark: int) -> Admission:
    """Trim what is at or below the watermark; GapError if samples between it and the batch are missing.

    An empty batch asks for the watermark, and may declare samples lost that no later ones follow; it is never a gap.
    """
    expected = watermark + 1
    missing = batch.first_seq - expected
    if not len(batch.rows):
        lost = missing if 0 < missing <= batch.lost_before else 0
        return Admission(replace(batch, first_seq=expected + lost), trimmed=0, lost=lost)
    if missing > batch.lost_before:
        raise GapError(batch.first_seq, expected)
    if missing >= 0:
        return Admission(batch, trimmed=0, lost=missing)
    trimmed = min(-missing, len(batch.rows))
    rest = replace(batch, first_seq=max(batch.first_seq + trimmed, expected), rows=batch.rows[trimmed:], lost_before=0)
    return Admission(rest, trimmed=trimmed, lost=0)
