"""What may enter the journal: rules of identity as pure functions."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

from mapserver.journal.rows import Admission, StoreIdentity
from protocol.errors import MessageError, Refusal
from protocol.site.site_config import SiteConfig
from protocol.units import DAY_NS
from protocol.wire import keys
from protocol.wire.messages import SampleBatch

Verify = Callable[[str, str, bytes, bytes], None]  # machine, key expression, payload, signature
FUTURE_NS = DAY_NS  # tolerance for clocks of the wrong zone or day
FIRST_NS = 1_767_225_600_000_000_000  # 2026-01-01: an earlier server clock is wrong


class GapError(MessageError):
    """A batch starts beyond the next expected sample, without declaring a loss."""

    def __init__(self, first_seq: int, expected: int) -> None:
        problem = f"{first_seq}: sample {expected} is expected next; send from there, or say lost_before"
        super().__init__(Refusal.GAP, problem, field="first_seq")
        self.expected = expected


@dataclass(frozen=True)
class SeenTime:
    """Times known to a store besides the server's clock, 0 for none.

    others_ns, newest_ns: newest stamp of other trusted machines, and of all. received_ns: server time of the last row.
    """

    others_ns: int = 0
    newest_ns: int = 0
    received_ns: int = 0


def nothing_seen(_: str) -> SeenTime:
    """A new store's times."""
    return SeenTime()


def judge_batch(
    batch: SampleBatch,
    machine: str,
    site: SiteConfig,
    now_ns: Callable[[], int],
    seen: Callable[[str], SeenTime] = nothing_seen,
) -> None:
    """Check a batch that came under a machine's key; MessageError names the fault. seen: asked about future batches."""
    if batch.machine != machine:
        problem = f"{batch.machine!r} sends under the key of {machine!r}"
        raise MessageError(Refusal.WRONG_MACHINE, problem, field="machine")
    if batch.frame != site.frame:
        problem = f"{batch.frame[:16]!r}: the frame of site {site.name} is {site.frame!r}; compare the site files"
        raise MessageError(Refusal.WRONG_FRAME, problem, field="frame")
    if len(batch.rows):
        _check_newest(batch, site, now_ns(), seen)


def _check_newest(batch: SampleBatch, site: SiteConfig, now_ns: int, seen: Callable[[str], SeenTime]) -> None:
    """Refuse stamps that move the site's now: a sample of 2099 would make all others old."""
    row = int(batch.rows["stamp_ns"].argmax())
    stamp_ns = int(batch.rows["stamp_ns"][row])
    ahead_ns = stamp_ns - now_ns
    if ahead_ns > FUTURE_NS and stamp_ns - (time := seen(batch.machine)).others_ns > FUTURE_NS:
        behind_ns = max(FIRST_NS, time.received_ns, time.newest_ns - FUTURE_NS) - now_ns
        if behind_ns > 0:  # such a clock says nothing about samples
            problem = (
                f"the server's clock is {_days(ahead_ns)} behind this sample, and {_days(behind_ns)} behind what its"
            )
            problem += " store has seen; set the server's clock"
            raise MessageError(Refusal.SERVER_CLOCK, problem, field="stamp_ns", row=row)
        problem = f"{_days(ahead_ns)} ahead of the server's clock and of all other machines; set the machine's clock"
        raise MessageError(Refusal.FAR_FUTURE, problem, field="stamp_ns", row=row)
    if site.clock == "wall" and ahead_ns * 1e-9 > site.clock_tolerance_s:
        problem = f"{ahead_ns * 1e-9:.1f} s ahead of the server's clock; set the machine's clock"
        raise MessageError(Refusal.WALL_CLOCK, problem, field="stamp_ns", row=row)


def _days(span_ns: int) -> str:
    return f"{span_ns / DAY_NS:.1f} days"


def check_store(batch: SampleBatch, identity: StoreIdentity, accepted: Collection[str]) -> str:
    """The id of the store that this one replaces for a batch, or ""; MessageError if it may not.

    accepted: ids of stores that people replaced.
    """
    if batch.store in ("", identity.id):
        return ""
    if batch.store in identity.descends or batch.store in accepted:
        return batch.store
    problem = f"earlier samples of this run are in store {batch.store}, and this is store {identity.id}: start the"
    problem += f" server with that one, or `sitegrid accept {batch.store}` if it is gone"
    raise MessageError(Refusal.OTHER_STORE, problem, field="store")


def signature_problem(verify: Verify, site: str, machine: str, payload: bytes, signature: bytes) -> MessageError | None:
    """What is wrong with a batch's signature, or None. machine: of its key."""
    if not machine:
        return MessageError(Refusal.WRONG_MACHINE, "the key names no machine")
    try:
        verify(machine, keys.ingest(site, machine), payload, signature)
    except MessageError as error:
        return error
    return None


def admit(batch: SampleBatch, watermark: int) -> Admission:
    """Drop samples up to the watermark; GapError if earlier ones are missing.

    An empty batch asks for the watermark, may declare losses, and is never a gap.
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
