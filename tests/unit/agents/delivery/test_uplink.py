import itertools
import math
import random
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.delivery.spool import Spool, SpoolConfig
from agents.delivery.uplink import BLOCKING, PASSING, UplinkConfig, UplinkState, linger
from mapserver.ingest.admission import GapError, admit, parse
from protocol.errors import MessageError, Refusal
from protocol.machine.samples import content_hash
from protocol.wire.codec import decode_batch, decode_reply, encode_reply
from protocol.wire.messages import Ack, Refused, SampleBatch
from tests.unit.agents.drives import SITE, made_up_samples

ROWS = made_up_samples(500)
QUICK_S = 0.01  # an exchange over a good link
TIMEOUT_S = UplinkConfig().timeout_s
MEMORY = Path(":memory:")  # the spool's files have tests of their own


class Server:
    """Admits batches as the map server does, and keeps every sample that it took."""

    def __init__(self) -> None:
        self.watermarks: Counter[int] = Counter()
        self.taken: Counter[tuple[int, int, str]] = Counter()
        self.lost = 0

    def answer(self, payload: bytes) -> Ack | Refused:
        try:
            batch = parse(payload, "loader-1", SITE, lambda: 0)
            admission = admit(batch, self.watermarks[batch.spool_id])
        except GapError as error:
            return Refused(error.reason, str(error), error.expected)
        except MessageError as error:
            return Refused(error.reason, str(error))
        new = admission.batch
        for i, row in enumerate(new.rows):
            self.taken[new.spool_id, new.first_seq + i, content_hash(row)] += 1
        self.lost += admission.lost
        self.watermarks[batch.spool_id] = max(self.watermarks[batch.spool_id], admission.watermark)
        return Ack(self.watermarks[batch.spool_id], 1, admission.trimmed)


def uplink(n: int = 0, max_samples: int = 10_000, **options: Any) -> tuple[UplinkState, Spool]:
    spool = Spool(MEMORY, SpoolConfig(max_samples))
    if n:
        spool.record(ROWS[:n])
    return UplinkState("loader-1", SITE.frame, spool, UplinkConfig(**options), np.random.default_rng(0)), spool


def met(n: int = 0, max_samples: int = 10_000, **options: Any) -> tuple[UplinkState, Spool]:
    """An uplink that the server has answered once."""
    state, spool = uplink(max_samples=max_samples, **options)
    assert state.next_payload()
    assert heard(state, Ack(0, 0)) == 0
    if n:
        spool.record(ROWS[:n])
    return state, spool


def heard(state: UplinkState, reply: Ack | Refused | None) -> float:
    """Hand in an answer that came at once, or none within the time-out; returns the pause."""
    return state.on_reply(reply, TIMEOUT_S if reply is None else QUICK_S)


def silence(state: UplinkState) -> float:
    """Nothing came within the time-out."""
    return heard(state, None)


def next_batch(state: UplinkState) -> SampleBatch:
    payload = state.next_payload()
    assert payload
    return decode_batch(payload, 1e9)


def test_first_payload_of_an_empty_spool_is_a_question() -> None:
    state, spool = uplink()
    batch = next_batch(state)
    assert (batch.machine, batch.spool_id, batch.frame) == ("loader-1", spool.spool_id, SITE.frame)
    assert (batch.first_seq, len(batch.rows), batch.lost_before) == (1, 0, 0)
    heard(state, Ack(0, 0))
    assert state.next_payload() is None


def test_samples_need_no_question() -> None:
    state, _ = uplink(5)
    assert len(next_batch(state).rows) == 5


def test_question_is_asked_until_somebody_answers() -> None:
    state, _ = uplink()
    for _ in range(3):
        assert len(next_batch(state).rows) == 0
        silence(state)
    assert state.problem == "no answer from the map server within 3 s"
    heard(state, Ack(0, 0))
    assert state.next_payload() is None
    assert state.problem == ""


def test_held_uplink_sends_nothing() -> None:
    state, _ = uplink(5)
    state.held = "another agent has this name"
    assert state.next_payload() is None
    state.held = ""
    assert len(next_batch(state).rows) == 5


def test_empty_spool_has_nothing_to_send() -> None:
    state, spool = met()
    assert state.next_payload() is None
    spool.record(ROWS[:1])
    assert len(next_batch(state).rows) == 1


def test_nothing_is_deleted_before_the_acknowledgement() -> None:
    state, spool = met(5)
    for reply in (None, Refused(Refusal.OVERLOADED, ""), Refused(Refusal.STORE, "")):
        next_batch(state)
        heard(state, reply)
        assert spool.counters()["depth"] == 5
    next_batch(state)
    heard(state, Ack(5, 1))
    assert spool.counters()["depth"] == 0
    assert state.counters["batches"] == 1


def test_batch_is_halved_on_a_time_out_and_doubled_on_success() -> None:
    state, _ = met(500, batch_samples=64, max_batch_samples=100)
    sizes = []
    for reply in ("lost", "lost", "ok", "ok", "ok", "ok"):
        batch = next_batch(state)
        sizes.append(len(batch.rows))
        heard(state, None if reply == "lost" else Ack(batch.last_seq, 1))
    assert sizes == [64, 32, 16, 32, 64, 100]
    assert state.counters["timeouts"] == 2


def test_batch_is_never_less_than_one_sample() -> None:
    state, _ = met(500, batch_samples=4)
    for _ in range(20):
        state.next_payload()
        silence(state)
    assert len(next_batch(state).rows) == 1


@pytest.mark.parametrize("reply", [None, Refused(Refusal.OVERLOADED, "")])
def test_pause_doubles_up_to_its_bound_and_starts_anew_after_success(reply: Refused | None) -> None:
    state, _ = met(5, backoff_s=0.2, max_backoff_s=1.5)
    pauses = []
    for _ in range(2000):
        state.next_payload()
        pauses.append(heard(state, reply))
    for pause, most in zip(pauses, (0.2, 0.4, 0.8, *[1.5] * 1997), strict=True):
        assert most / 2 <= pause <= most
    next_batch(state)
    heard(state, Ack(5, 1))
    state._spool.record(ROWS[5:6])
    state.next_payload()
    assert silence(state) <= 0.2


def test_pauses_of_a_fleet_spread() -> None:
    pauses = []
    for seed in range(100):
        state = UplinkState(
            "loader-1", SITE.frame, Spool(MEMORY, SpoolConfig()), UplinkConfig(), np.random.default_rng(seed)
        )
        state.next_payload()
        pauses.append(silence(state))
    assert max(pauses) - min(pauses) > 0.4 * UplinkConfig().backoff_s
    assert len(set(pauses)) == 100


# --- the link --------------------------------------------------------------------------------------------------------


def test_missing_server_leaves_the_batch_as_it_is() -> None:
    state, _ = met(500, batch_samples=64)
    for _ in range(10):
        state.next_payload()
        assert state.on_reply(None, 0.001) > 0
    assert "is one running" in state.problem
    assert state.counters["unanswered"] == 10
    assert len(next_batch(state).rows) == 64


@pytest.mark.parametrize(
    ("rate_bps", "delay_s", "jitter_s"),
    [(300e3, 0.05, 0.0), (300e3, 0.3, 0.2), (30e3, 0.1, 0.1), (1e6, 0.05, 0.1), (10e6, 0.02, 0.0), (300e3, 1.6, 0.0)],
)
def test_batch_fits_the_link(rate_bps: float, delay_s: float, jitter_s: float) -> None:
    """The link is used well, an exchange takes about a third of the time-out, and few run into it."""
    rng = np.random.default_rng(1)
    state, spool = met(max_samples=100_000)
    spool.record(made_up_samples(60_000))
    took, sent, now_s = [], 0, 0.0
    while now_s < 120 and (payload := state.next_payload()):
        need_s = delay_s + rng.uniform(0, jitter_s) + 8 * len(payload) / rate_bps
        batch = decode_batch(payload, 1e9)
        if need_s < TIMEOUT_S:
            sent += len(batch.rows)
            took.append(need_s)
            now_s += need_s + state.on_reply(Ack(batch.last_seq, 1), need_s)
        else:
            now_s += TIMEOUT_S + silence(state)
    late = took[len(took) // 2 :]
    assert state.counters["timeouts"] <= 3
    # Smaller batches would not help where the delay alone takes that long, nor where the first one is small already.
    assert np.median(late) < max(1.2, 1.2 * delay_s + 0.5) if rate_bps > 100e3 else max(late) < TIMEOUT_S
    share = sent * 68 * 8 / rate_bps / now_s
    assert sent == 60_000 or share > (0.6 if delay_s < 0.2 else 0.15)


def test_link_that_gets_slower_costs_few_time_outs() -> None:
    state, spool = met(max_samples=100_000)
    spool.record(made_up_samples(60_000))
    rates, timeouts = [10e6] * 8 + [100e3] * 20, 0
    for rate_bps in rates:
        payload = state.next_payload()
        assert payload
        need_s = 0.05 + 8 * len(payload) / rate_bps
        if need_s < TIMEOUT_S:
            state.on_reply(Ack(decode_batch(payload, 1e9).last_seq, 1), need_s)
        else:
            silence(state)
            timeouts += 1
    assert timeouts <= 5
    assert need_s < TIMEOUT_S / 2


def test_server_that_lost_samples_is_told_so() -> None:
    """It was restored from a backup after this agent had met it."""
    state, spool = met(20, batch_samples=5, max_batch_samples=5)
    heard(state, Ack(next_batch(state).last_seq, 1))
    assert next_batch(state).first_seq == 6
    assert heard(state, Refused(Refusal.GAP, "expected 3", 3)) == 0
    batch = next_batch(state)
    assert (batch.first_seq, batch.lost_before) == (6, 3)
    assert state.counters["refused_gap"] == 1
    assert spool.counters()["put_aside"] == 0


@pytest.mark.parametrize("watermark", [0, 5])
def test_ack_that_moves_nothing_is_no_reason_to_hurry(watermark: int) -> None:
    state, spool = met(10, batch_samples=5)
    heard(state, Ack(next_batch(state).last_seq, 1))
    next_batch(state)
    assert heard(state, Ack(watermark, 1)) > 0
    assert f"acknowledges {watermark}" in state.problem
    assert spool.counters()["depth"] == 5


def test_gap_that_names_no_expected_sample_puts_nothing_aside() -> None:
    state, spool = met(1)
    for expected in (0, 99):
        next_batch(state)
        assert heard(state, Refused(Refusal.GAP, "?", expected)) > 0
    batch = next_batch(state)
    assert (batch.first_seq, batch.lost_before) == (1, 0)
    assert spool.counters()["put_aside"] == 0


@pytest.mark.parametrize("bad", [0, 7, 19])
def test_refused_batch_is_bisected_to_the_one_bad_sample(bad: int) -> None:
    rows = ROWS[:20].copy()
    rows["c_rr"][bad] = 99.0
    state, spool = met(batch_samples=20, gather_s=0.0)
    spool.record(rows)
    server = Server()
    for _ in range(60):
        payload = state.next_payload()
        if payload is None:
            break
        assert heard(state, server.answer(payload)) == 0
    good = [content_hash(row) for i, row in enumerate(rows) if i != bad]
    assert sorted(h for _, _, h in server.taken) == sorted(good)
    assert set(server.taken.values()) == {1}
    assert server.lost == (bad < 19)
    assert spool.counters() == {"depth": 0, "dropped": 0, "put_aside": 1, "recorded": 20}
    assert spool._db.execute("SELECT seq, row FROM aside").fetchall() == [(bad + 1, rows[bad].tobytes())]
    assert state.counters["refused_out_of_range"] >= 1


def test_bisection_halves() -> None:
    state, _ = met(16, batch_samples=16)
    sizes = []
    for _ in range(4):
        sizes.append(len(next_batch(state).rows))
        heard(state, Refused(Refusal.NOT_FINITE, "c_rr[0]"))
    assert sizes == [16, 8, 4, 2]


@pytest.mark.parametrize("reason", sorted(BLOCKING | PASSING))
def test_what_is_no_sample_s_fault_puts_nothing_aside(reason: Refusal) -> None:
    state, spool = met(1)
    for _ in range(5):
        next_batch(state)
        assert heard(state, Refused(reason, "as it is")) > 0
    assert state.problem == "as it is"
    assert state.counters[f"refused_{reason}"] == 5
    assert spool.counters()["put_aside"] == 0
    assert next_batch(state).first_seq == 1


def test_question_that_is_refused_is_asked_again() -> None:
    state, _ = uplink()
    state.next_payload()
    assert heard(state, Refused(Refusal.FIRST_SEQ, "?")) > 0
    assert len(next_batch(state).rows) == 0


def test_numbers_that_somebody_else_has_used_move_to_a_new_identity() -> None:
    """A virtual machine that was set back while it ran: the server knows more of this run than the run itself."""
    state, spool = met(5)
    heard(state, Ack(next_batch(state).last_seq, 1))
    old = spool.spool_id
    spool.record(ROWS[5:8])
    next_batch(state)
    assert heard(state, Ack(50, 1, trimmed=3)) == 0
    batch = next_batch(state)
    assert state.counters["new_spool_ids"] == 1
    assert (batch.spool_id, batch.first_seq, batch.lost_before) == (spool.spool_id, 1, 0)
    assert spool.spool_id != old
    assert [content_hash(r) for r in batch.rows] == [content_hash(r) for r in ROWS[5:8]]


def reopened(tmp_path: Path, n: int = 0, acknowledged: int = 0) -> tuple[UplinkState, Spool, int]:
    """An uplink whose spool had a run before: of n samples, some acknowledged; and that run's identity."""
    spool = Spool(tmp_path / "spool.db", SpoolConfig())
    earlier = spool.spool_id
    spool.record(ROWS[:n])
    spool.acknowledge(earlier, acknowledged)
    spool.close()
    spool = Spool(tmp_path / "spool.db", SpoolConfig())
    return UplinkState("loader-1", SITE.frame, spool, UplinkConfig()), spool, earlier


def test_earlier_run_is_sent_first_then_closed(tmp_path: Path) -> None:
    state, spool, earlier = reopened(tmp_path, 5, acknowledged=2)
    spool.record(ROWS[5:8])
    batch = next_batch(state)
    assert (batch.spool_id, batch.first_seq, len(batch.rows)) == (earlier, 3, 3)
    heard(state, Ack(5, 1))
    batch = next_batch(state)
    assert (batch.spool_id, batch.first_seq, len(batch.rows)) == (spool.spool_id, 1, 3)
    spool.close()


@pytest.mark.parametrize("watermark", [0, 5, 9])
def test_run_that_is_delivered_is_closed_with_one_empty_batch(tmp_path: Path, watermark: int) -> None:
    """A server that was restored from a backup learns so what it has lost; one that knows it all changes nothing."""
    state, spool, earlier = reopened(tmp_path, 5, acknowledged=5)
    batch = next_batch(state)
    assert (batch.spool_id, batch.first_seq, len(batch.rows), batch.lost_before) == (earlier, 6, 0, 5)
    assert not spool.is_settled()
    assert heard(state, Ack(watermark, 1)) == 0
    assert spool.is_settled()
    assert state.next_payload() is None
    spool.close()


def test_full_spool_declares_what_it_dropped() -> None:
    state, spool = uplink(5, max_samples=10)
    server = Server()
    spool.record(ROWS[5:20])
    while payload := state.next_payload():
        heard(state, server.answer(payload))
    assert server.lost == 10
    assert sorted(seq for _, seq, _ in server.taken) == list(range(11, 21))


def exchange(state: UplinkState, server: Server, rng: random.Random, quality: float) -> None:
    """One round over a link that loses requests and replies, and repeats requests."""
    payload = state.next_payload()
    if payload is None:
        return
    arrivals = [payload for _ in range(rng.choice((1, 1, 1, 2))) if rng.random() < quality]
    answers = [decode_reply(encode_reply(server.answer(arrival))) for arrival in arrivals]
    is_heard = answers and rng.random() < quality
    heard(state, rng.choice(answers) if is_heard else None)


@pytest.mark.parametrize("first_seed", range(0, 50, 25))
def test_lossy_link_delivers_every_sample_exactly_once(first_seed: int) -> None:
    for seed in range(first_seed, first_seed + 25):
        rng = random.Random(seed)
        server = Server()
        state, spool = uplink(batch_samples=rng.choice((1, 4, 16)), max_batch_samples=32)
        waiting = list(ROWS[:120])
        for _ in itertools.count():
            while waiting and rng.random() < 0.5:
                n = rng.randint(1, 9)
                spool.record(ROWS[120 - len(waiting) :][: min(n, len(waiting))])
                waiting = waiting[n:]
            exchange(state, server, rng, quality=0.6)
            if not waiting and not spool.counters()["depth"]:
                break
        assert set(server.taken.values()) == {1}, f"seed={seed}"
        expected = [(spool.spool_id, i + 1, content_hash(row)) for i, row in enumerate(ROWS[:120])]
        assert sorted(server.taken) == sorted(expected), f"seed={seed}"
        assert server.lost == 0, f"seed={seed}"


@pytest.mark.parametrize("seed", range(8))
def test_agent_that_is_killed_again_and_again_delivers_every_sample_exactly_once(tmp_path: Path, seed: int) -> None:
    rng = random.Random(seed)
    server = Server()
    recorded = 0
    spool = None
    for _ in range(12):
        spool = Spool(tmp_path / "spool.db", SpoolConfig())
        state = UplinkState("loader-1", SITE.frame, spool, UplinkConfig(batch_samples=8))
        for _ in range(rng.randint(0, 6)):
            if recorded < 120:
                recorded += len(ROWS[recorded : recorded + 5])
                spool.record(ROWS[recorded - 5 : recorded])
            exchange(state, server, rng, quality=0.7)
        spool._db.close()  # without a checkpoint, as a kill leaves it
    spool = Spool(tmp_path / "spool.db", SpoolConfig())
    state = UplinkState("loader-1", SITE.frame, spool, UplinkConfig())
    while not spool.is_settled():
        exchange(state, server, rng, quality=0.9)
    assert sorted(h for _, _, h in server.taken) == sorted(content_hash(r) for r in ROWS[:recorded]), f"seed={seed}"
    assert set(server.taken.values()) <= {1}, f"seed={seed}"
    spool.close()


def test_failing_disk_pauses_the_uplink_and_loses_nothing() -> None:
    state, spool = met(5)
    assert 0 < state.on_disk_error(OSError("disk is full")) <= UplinkConfig().backoff_s
    assert "disk is full; look at the machine's disk" in state.problem
    assert state.counters["disk_errors"] == 1
    assert len(next_batch(state).rows) == 5
    assert spool.counters()["depth"] == 5


def test_linger_waits_until_the_spool_is_empty_or_time_is_over() -> None:
    clock = itertools.count(0.0, 0.05)
    left = iter([False, False, True])
    waits: list[float] = []
    assert linger(lambda: next(left), waits.append, lambda: next(clock), 10.0)
    assert len(waits) == 2
    waits.clear()
    assert not linger(lambda: False, waits.append, lambda: next(clock), 1.0)
    assert len(waits) == pytest.approx(20, abs=2)
    assert not linger(lambda: False, waits.append, lambda: 0.0, 0.0)
    assert linger(lambda: True, waits.append, lambda: 0.0, 0.0)


OPTIONS: dict[str, Any] = {
    "batch_samples": 3,
    "max_batch_samples": 30,
    "backoff_s": 0.5,
    "max_backoff_s": 0.3,
    "gather_s": 3.0,
}
BASE: dict[str, Any] = {"batch_samples": 20, "max_batch_samples": 80}


def trace(**options: Any) -> list[Any]:
    """Sizes and pauses of a fixed course of events."""
    state, _ = met(500, **BASE | options)
    found: list[Any] = []
    for reply in ("ok", "ok", "lost", "ok", "lost", "lost", "lost"):
        batch = next_batch(state)
        found.append((len(batch.rows), heard(state, Ack(batch.last_seq, 1) if reply == "ok" else None)))
    while payload := state.next_payload():
        found.append(heard(state, Ack(decode_batch(payload, 1e9).last_seq, 1)))
    return found


def test_samples_gather_after_a_batch_that_left_nothing_behind() -> None:
    state, spool = met(50, batch_samples=20, max_batch_samples=20, gather_s=1.5)
    pauses = [heard(state, Ack(next_batch(state).last_seq, 1)) for _ in range(3)]
    assert pauses == [0.0, 0.0, 1.5]
    spool.record(ROWS[50:57])
    assert len(next_batch(state).rows) == 7


def test_runs_that_are_left_over_do_not_wait_for_one_another(tmp_path: Path) -> None:
    for first in (0, 3, 6):
        spool = Spool(tmp_path / "spool.db", SpoolConfig())
        spool.record(ROWS[first : first + 3])
        if first < 6:
            spool.close()
    state = UplinkState("loader-1", SITE.frame, spool, UplinkConfig(gather_s=1.5), np.random.default_rng(0))
    server = Server()
    pauses = [heard(state, server.answer(state.next_payload() or b"")) for _ in range(3)]
    assert pauses == [0.0, 0.0, 1.5]
    spool.close()


@pytest.mark.parametrize("name", sorted(OPTIONS))
def test_option_changes_what_is_sent_or_when(name: str) -> None:
    assert set(OPTIONS) | {"timeout_s"} == set(UplinkConfig.__dataclass_fields__)
    assert trace(**{name: OPTIONS[name]}) != trace()


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"batch_samples": 0}, "batch_samples"),
        ({"max_batch_samples": 100}, "max_batch_samples"),
        ({"max_batch_samples": 20_001}, "max_batch_samples"),
        ({"timeout_s": 0.0}, "timeout_s"),
        ({"backoff_s": 0.0}, "backoff_s"),
        ({"max_backoff_s": 0.1}, "max_backoff_s"),
        ({"gather_s": -0.1}, "gather_s"),
        ({"gather_s": 61.0}, "gather_s"),
        ({"gather_s": math.nan}, "gather_s"),
    ],
)
def test_bad_uplink_option_is_refused_by_name(options: dict[str, Any], named: str) -> None:
    with pytest.raises(ValueError, match=named):
        UplinkConfig(**options)
