import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.delivery.spool import Spool, SpoolConfig
from agents.delivery.uplink import (
    BLOCKING,
    PASSING,
    Action,
    Delete,
    Head,
    Pacing,
    Quarantine,
    Send,
    SpoolAction,
    Uplink,
    UplinkConfig,
    Wait,
)
from agents.delivery.uplink_thread import perform
from protocol.errors import Refusal
from protocol.machine.samples import SAMPLE_DTYPE, content_hash
from protocol.wire.codec import decode_batch
from protocol.wire.messages import Ack, Refused, SampleBatch
from tests.unit.agents.drives import SITE, made_up_samples

ROWS = made_up_samples(500)
QUICK_S = 0.01  # exchange on a good link
TIMEOUT_S = UplinkConfig().timeout_s


class Delivery:
    """An uplink and its spool with their actions carried out; the test is the network and the server."""

    folder: Path  # for spools
    _names = itertools.count()

    def __init__(self, n: int = 0, spool: Spool | None = None, max_samples: int = 10_000, **pacing: Any) -> None:
        self.spool = spool or Spool(self.folder / f"{next(self._names)}.db", SpoolConfig(max_samples))
        if n:
            self.spool.record(ROWS[:n])
        self.quarantined: list[tuple[int, str]] = []
        self.uplink = Uplink("loader-1", SITE.frame, TIMEOUT_S, Pacing(**pacing), np.random.default_rng(0))

    def payload(self) -> bytes | None:
        """The next payload; None if waiting for samples."""
        action = self._until(self.uplink.start_exchange())
        assert isinstance(action, Send) or action.for_samples
        return action.payload if isinstance(action, Send) else None

    def batch(self) -> SampleBatch:
        payload = self.payload()
        return decode_batch(payload, 1e9)

    def reply(self, reply: Ack | Refused | None, took_s: float | None = None) -> float:
        """Answer the last payload, at once or (None) by time-out; returns the pause."""
        took_s = took_s or (TIMEOUT_S if reply is None else QUICK_S)
        action = self._until(self.uplink.on_reply(reply, took_s))
        assert isinstance(action, Wait)
        assert not action.for_samples
        return action.seconds

    def counter(self, name: str) -> int:
        return self.spool.counters()[name]

    def _until(self, action: Action) -> Send | Wait:
        while not isinstance(action, Send | Wait):
            if isinstance(action, Quarantine):
                self.quarantined += [(action.head.first_seq, content_hash(row)) for row in action.head.rows]
            action = perform(action, self.uplink, self.spool, lambda _: (None, 0.0))
        return action


@pytest.fixture(autouse=True)
def _folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Delivery, "folder", tmp_path, raising=False)


def met(n: int = 0, **options: Any) -> Delivery:
    """An uplink after the server's first answer."""
    delivery = Delivery(**options)
    assert delivery.payload()
    assert delivery.reply(Ack(0, 0)) == 0
    if n:
        delivery.spool.record(ROWS[:n])
    return delivery


def test_first_payload_of_an_empty_spool_is_a_question_until_somebody_answers() -> None:
    d = Delivery()
    d.batch()
    d.reply(None)
    assert d.uplink.problem == "no answer from the map server within 3 s"
    batch = d.batch()
    assert (batch.machine, batch.spool_id, batch.frame) == ("loader-1", d.spool.spool_id, SITE.frame)
    assert (batch.first_seq, len(batch.rows), batch.lost_before) == (1, 0, 0)
    d.reply(Ack(0, 0))
    assert d.payload() is None


def test_batch_is_halved_on_a_time_out_and_doubled_on_success() -> None:
    d = met(500, first_batch=64, max_batch=100)
    sizes = []
    for reply in ("lost", "lost", "ok", "ok", "ok", "ok"):
        batch = d.batch()
        sizes.append(len(batch.rows))
        d.reply(None if reply == "lost" else Ack(batch.last_seq, 1))
    assert sizes == [64, 32, 16, 32, 64, 100]
    assert d.uplink.counters["timeouts"] == 2


@pytest.mark.parametrize(("asked_s", "least_s"), [(0.3, 0.3), (4.0, 4.0), (3000.0, 5.0)])
def test_a_machine_comes_again_when_the_server_has_room_and_not_all_at_once(asked_s: float, least_s: float) -> None:
    """As often as asked, never much later than by itself."""
    d = met(5, max_backoff_s=5.0)
    pauses = []
    for _ in range(50):
        d.payload()
        pauses.append(d.reply(Refused(Refusal.OVERLOADED, "", retry_after_s=asked_s)))
    assert least_s <= min(pauses) < 1.1 * least_s
    assert 1.4 * least_s < max(pauses) <= 1.5 * least_s
    d.payload()
    assert d.reply(None) <= 0.2  # independent of failures
    assert d.counter("depth") == 5


@pytest.mark.parametrize("reply", [None, Refused(Refusal.OVERLOADED, "")])
def test_pause_doubles_up_to_its_bound_and_starts_anew_after_success(reply: Refused | None) -> None:
    d = met(5, backoff_s=0.2, max_backoff_s=1.5)
    pauses = []
    for _ in range(60):
        d.payload()
        pauses.append(d.reply(reply))
    for pause, most in zip(pauses, (0.2, 0.4, 0.8, *[1.5] * 57), strict=True):
        assert most / 2 <= pause <= most
    assert max(pauses) - min(pauses[3:]) > 0.6  # a fleet's are spread
    d.batch()
    d.reply(Ack(5, 1))
    d.spool.record(ROWS[5:6])
    d.payload()
    assert d.reply(None) <= 0.2


# --- the link --------------------------------------------------------------------------------------------------------


def test_missing_server_leaves_the_batch_as_it_is() -> None:
    d = met(500, first_batch=64)
    for _ in range(10):
        d.payload()
        assert d.reply(None, 0.001) > 0
    assert "is one running" in d.uplink.problem
    assert d.uplink.counters["unanswered"] == 10
    assert len(d.batch().rows) == 64


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rate_bps", "delay_s", "jitter_s"),
    [(300e3, 0.3, 0.2), (30e3, 0.1, 0.1), (300e3, 1.6, 0.0)],
)
def test_batch_fits_the_link(rate_bps: float, delay_s: float, jitter_s: float) -> None:
    """Good use of the link, exchanges of about a third of the time-out, few time-outs."""
    rng = np.random.default_rng(1)
    d = met(max_samples=100_000)
    d.spool.record(made_up_samples(60_000))
    took, sent, now_s = [], 0, 0.0
    while now_s < 120 and (payload := d.payload()):
        need_s = delay_s + rng.uniform(0, jitter_s) + 8 * len(payload) / rate_bps
        batch = decode_batch(payload, 1e9)
        if need_s < TIMEOUT_S:
            sent += len(batch.rows)
            took.append(need_s)
            now_s += need_s + d.reply(Ack(batch.last_seq, 1), need_s)
        else:
            now_s += TIMEOUT_S + d.reply(None)
    late = took[len(took) // 2 :]
    assert d.uplink.counters["timeouts"] <= 3
    # Smaller batches would not help where the delay alone takes as long or the first batch is small.
    assert np.median(late) < max(1.2, 1.2 * delay_s + 0.5) if rate_bps > 100e3 else max(late) < TIMEOUT_S
    share = sent * SAMPLE_DTYPE.itemsize * 8 / rate_bps / now_s
    assert sent == 60_000 or share > (0.6 if delay_s < 0.2 else 0.15)


def test_server_that_lost_samples_is_told_so() -> None:
    """It was restored from a backup."""
    d = met(20, first_batch=5, max_batch=5)
    d.reply(Ack(d.batch().last_seq, 1))
    assert d.batch().first_seq == 6
    assert d.reply(Refused(Refusal.GAP, "expected 3", 3)) == 0
    batch = d.batch()
    assert (batch.first_seq, batch.lost_before) == (6, 3)
    assert d.uplink.counters["refused_gap"] == 1
    assert d.counter("put_aside") == 0


@pytest.mark.parametrize("watermark", [0, 5])
def test_ack_that_moves_nothing_is_no_reason_to_hurry(watermark: int) -> None:
    d = met(10, first_batch=5)
    d.reply(Ack(d.batch().last_seq, 1))
    d.batch()
    assert d.reply(Ack(watermark, 1)) > 0
    assert f"acknowledges {watermark}" in d.uplink.problem
    assert d.counter("depth") == 5


def test_gap_that_names_no_expected_sample_quarantines_nothing() -> None:
    d = met(1)
    for expected in (0, 99):
        d.batch()
        assert d.reply(Refused(Refusal.GAP, "?", expected)) > 0
    batch = d.batch()
    assert (batch.first_seq, batch.lost_before) == (1, 0)
    assert d.counter("put_aside") == 0


@pytest.mark.parametrize("bad", [0, 19])
def test_refused_batch_is_bisected_to_the_one_bad_sample(bad: int) -> None:
    d, taken = met(20, first_batch=20, gather_s=0.0), []
    while payload := d.payload():
        batch = decode_batch(payload, 1e9)
        is_refused = batch.first_seq <= bad + 1 <= batch.last_seq
        taken += [] if is_refused else [content_hash(row) for row in batch.rows]
        assert d.reply(Refused(Refusal.OUT_OF_RANGE, "bad") if is_refused else Ack(batch.last_seq, 1)) == 0
    assert taken == [content_hash(row) for i, row in enumerate(ROWS[:20]) if i != bad]
    assert d.quarantined == [(bad + 1, content_hash(ROWS[bad]))]
    assert (d.counter("depth"), d.counter("put_aside")) == (0, 1)


@pytest.mark.parametrize("reason", sorted(BLOCKING | PASSING))
def test_what_is_no_sample_s_fault_quarantines_nothing(reason: Refusal) -> None:
    d = met(1)
    for _ in range(5):
        d.batch()
        assert d.reply(Refused(reason, "as it is")) > 0
    assert d.uplink.problem == "as it is"
    assert d.uplink.counters[f"refused_{reason}"] == 5
    assert d.counter("put_aside") == 0
    assert d.batch().first_seq == 1


def test_numbers_that_somebody_else_has_used_move_to_a_new_identity() -> None:
    """A virtual machine set back while running: the server knows more of the run than itself."""
    d = met(5)
    d.reply(Ack(d.batch().last_seq, 1))
    old = d.spool.spool_id
    d.spool.record(ROWS[5:8])
    d.batch()
    assert d.reply(Ack(50, 1, trimmed=3)) == 0
    batch = d.batch()
    assert d.uplink.counters["new_spool_ids"] == 1
    assert (batch.spool_id, batch.first_seq, batch.lost_before) == (d.spool.spool_id, 1, 0)
    assert d.spool.spool_id != old
    assert [content_hash(r) for r in batch.rows] == [content_hash(r) for r in ROWS[5:8]]


def reopened(tmp_path: Path, n: int = 0, acknowledged: int = 0) -> tuple[Delivery, int]:
    """An uplink after an earlier run of n samples, some acknowledged; the run's identity."""
    spool = Spool(tmp_path / "spool.db", SpoolConfig())
    earlier = spool.spool_id
    spool.record(ROWS[:n])
    spool.acknowledge(earlier, acknowledged)
    spool.close()
    return Delivery(spool=Spool(tmp_path / "spool.db", SpoolConfig())), earlier


@pytest.mark.parametrize("watermark", [0, 5, 9])
def test_run_that_is_delivered_is_closed_with_one_empty_batch(tmp_path: Path, watermark: int) -> None:
    """A restored server learns its loss; a complete one changes nothing."""
    d, earlier = reopened(tmp_path, 5, acknowledged=5)
    batch = d.batch()
    assert (batch.spool_id, batch.first_seq, len(batch.rows), batch.lost_before) == (earlier, 6, 0, 5)
    assert not d.spool.is_settled()
    assert d.reply(Ack(watermark, 1)) == 0
    assert d.spool.is_settled()
    assert d.payload() is None
    d.spool.close()


@pytest.mark.parametrize(
    ("row", "trimmed", "again"),
    [(9, 0, False), (7, 0, True), (7, 3, False), (6, 3, True)],
)
def test_runs_are_closed_again_when_the_journal_has_lost_rows(
    tmp_path: Path, row: int, trimmed: int, again: bool
) -> None:
    """The fault was after the earlier run's closing, before this run's first sample."""
    d, earlier = reopened(tmp_path, 5, acknowledged=5)
    d.batch()
    d.reply(Ack(5, 7, 0, FIRST))
    assert d.spool.is_settled()
    d.spool.record(ROWS[5:8])
    assert d.batch().spool_id == d.spool.spool_id
    d.reply(Ack(3, row, trimmed, FIRST))
    assert d.counter("depth") == 0
    assert d.uplink.counters["declared_again"] == again
    assert d.spool.is_settled() != again
    if again:
        batch = d.batch()
        assert (batch.spool_id, batch.first_seq, len(batch.rows), batch.lost_before) == (earlier, 6, 0, 5)
        d.reply(Ack(5, row, 0, FIRST))
        assert d.spool.is_settled()
    d.spool.close()


def test_the_longest_acknowledgement_counts_from_the_first_sending():
    uplink = Uplink("loader-1", SITE.frame, TIMEOUT_S)
    head = Head(7, 1, ROWS[:10], 0, newest=10)

    def exchange(reply: Ack | None, took_s: float) -> SpoolAction | Wait:
        uplink.on_head(head, 7)
        return uplink.on_reply(reply, took_s)

    assert isinstance(exchange(Ack(10, 1, 0), 0.2), Delete)
    assert uplink.ack_s_max == 0.2
    pause = exchange(None, TIMEOUT_S)
    assert isinstance(pause, Wait)
    exchange(Ack(10, 2, 0), 0.1)
    assert uplink.ack_s_max == pytest.approx(TIMEOUT_S + pause.seconds + 0.1), "with the pause, and both exchanges"
    exchange(Ack(10, 3, 0), 0.3)
    assert uplink.ack_s_max > TIMEOUT_S, "it keeps the longest"


# --- stores ----------------------------------------------------------------------------------------------------------

FIRST, SECOND = "a" * 16, "b" * 16


def bound_to_first(n: int = 8) -> Delivery:
    """An uplink with five of n samples acknowledged by the store FIRST."""
    d = met(n, first_batch=5)
    assert d.batch().store == ""  # nothing acknowledged yet: any store
    d.reply(Ack(5, 1, store=FIRST))
    return d


@pytest.mark.parametrize("store", [SECOND, ""])
def test_nothing_is_deleted_on_the_word_of_another_store(store: str):
    d = bound_to_first()
    d.batch()
    assert d.reply(Ack(8, 1, store=store)) > 0
    assert d.counter("depth") == 3
    assert FIRST in d.uplink.problem
    assert d.uplink.counters["other_store"] == 1
    assert d.batch().first_seq == 6  # the same again, until the right store answers
    d.reply(Ack(8, 2, store=FIRST))
    assert (d.counter("depth"), d.uplink.problem) == (0, "")


def test_a_store_that_replaces_another_learns_what_it_lacks():
    d = bound_to_first()
    d.batch()
    d.reply(Refused(Refusal.GAP, "", expected=1))  # accepted: it has none of the run
    sent = d.batch()
    assert (sent.first_seq, sent.lost_before, sent.store) == (6, 5, FIRST)
    assert d.reply(Refused(Refusal.GAP, "", expected=3)) > 0, "a gap in what was declared lost says nothing"
    assert d.uplink.counters["lowered_watermarks"] == 1
    d.batch()
    d.reply(Ack(8, 1, store=SECOND, replaces=FIRST))
    assert d.counter("depth") == 0
    d.spool.record(ROWS[8:9])
    assert d.batch().store == SECOND


def test_an_offer_is_kept_from_an_acknowledgement_that_is_believed() -> None:
    delivery = met(3)
    delivery.payload()
    delivery.reply(Ack(1, 1, store=FIRST, offer={"zero": 0.004}))
    assert delivery.uplink.offer == {"zero": 0.004}
    delivery.payload()
    delivery.reply(Ack(2, 2, store=FIRST))
    assert delivery.uplink.offer == {"zero": 0.004}
    delivery.payload()
    delivery.reply(Ack(3, 3, store="f" * 16, offer={"zero": 0.1}))  # the run is bound to another store
    assert delivery.uplink.offer == {"zero": 0.004}
