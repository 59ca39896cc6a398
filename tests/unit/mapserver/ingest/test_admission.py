from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapserver.evidence.fold_config import FoldConfig
from mapserver.ingest.admission import GapError, SeenTime, admit, judge_batch
from mapserver.ingest.batches import decode_batches
from mapserver.ingest.block_credit import BlockCredit
from protocol.arrays import Table
from protocol.errors import MessageError, Refusal
from protocol.machine.samples import COLUMNS, LIMITS, SAMPLE_DTYPE
from protocol.wire.codec import decode_batch, encode_batch
from tests.unit.mapserver.data import NOW_NS, SITE, batch, folded, now_ns, random_samples, refused, samples


def numbered(first: int, n: int, **more):
    return batch(samples(n, stamp_ns=np.arange(first, first + n)), first, **more)


def numbers(admission) -> list[int]:
    return admission.batch.rows["stamp_ns"].tolist()


@pytest.mark.parametrize(
    ("first", "n", "watermark", "new", "trimmed"),
    [
        (1, 5, 0, [1, 2, 3, 4, 5], 0),  # first of all
        (4, 2, 3, [4, 5], 0),  # consecutive
        (1, 5, 3, [4, 5], 3),  # overlapping
        (1, 5, 5, [], 5),  # duplicate
        (1, 5, 9, [], 5),  # long known
    ],
)
def test_what_is_there_already_is_trimmed(first, n, watermark, new, trimmed):
    admission = admit(numbered(first, n, lost_before=5 * (first > 1)), watermark)
    assert numbers(admission) == new
    assert (admission.trimmed, admission.lost) == (trimmed, 0)
    assert admission.watermark == max(watermark, first + n - 1)
    if new:
        assert admission.batch.first_seq == new[0]


def judged(sent, machine="a", site=SITE):
    judge_batch(sent, machine, site, now_ns)


def test_a_stamp_ahead_of_the_wall_clock_is_refused_where_the_site_says_so():
    wall = replace(SITE, clock="wall", clock_tolerance_s=2.0)
    at_limit, beyond = (samples(3, stamp_ns=[NOW_NS - 10**12, NOW_NS + ahead, NOW_NS]) for ahead in (2e9, 2.1e9))
    judged(batch(at_limit), site=wall)
    judged(batch(samples(0)), site=wall)
    judged(batch(beyond))  # clock = "data"
    with pytest.raises(MessageError, match=r"2\.1 s ahead") as caught:
        judged(batch(beyond), site=wall)
    assert (caught.value.reason, caught.value.row) == (Refusal.WALL_CLOCK, 1)


DAY = 86_400 * 10**9


@pytest.mark.parametrize("clock", ["data", "wall"])
@pytest.mark.parametrize(
    ("ahead_ns", "seen", "reason"),
    [
        (DAY + 1, SeenTime(), Refusal.FAR_FUTURE),  # new store
        (73 * 365 * DAY, SeenTime(NOW_NS, NOW_NS + DAY, NOW_NS), Refusal.FAR_FUTURE),  # year 2099
        (3 * DAY, SeenTime(NOW_NS + DAY, NOW_NS + DAY), Refusal.FAR_FUTURE),  # ahead of all others
        (3 * DAY, SeenTime(0, NOW_NS + DAY, NOW_NS), Refusal.FAR_FUTURE),  # its own earlier stamps prove nothing
        (3 * DAY, SeenTime(0, 0, NOW_NS + 1), Refusal.SERVER_CLOCK),  # the server's clock went back
        (3 * DAY, SeenTime(0, NOW_NS + DAY + 1), Refusal.SERVER_CLOCK),
    ],
)
def test_a_stamp_a_day_ahead_of_all_that_is_known_is_refused_with_its_row(clock, ahead_ns, seen, reason):
    sent = batch(samples(3, stamp_ns=[NOW_NS, NOW_NS + ahead_ns, NOW_NS]))
    with pytest.raises(MessageError) as caught:
        judge_batch(sent, "a", replace(SITE, clock=clock), now_ns, lambda machine: {"a": seen}[machine])
    assert (caught.value.reason, caught.value.field, caught.value.row) == (reason, "stamp_ns", 1)


@pytest.mark.parametrize(
    ("ahead_ns", "seen"),
    [
        (DAY, SeenTime()),
        (3 * DAY, SeenTime(NOW_NS + 2 * DAY, NOW_NS + 2 * DAY)),  # agrees with others: the server's clock is behind
        (-(10**18), SeenTime()),  # a log of 1994
    ],
)
def test_a_stamp_that_others_bear_out_passes_a_site_that_goes_by_its_data(ahead_ns, seen):
    sent = batch(samples(1, stamp_ns=NOW_NS + ahead_ns))
    judge_batch(sent, "a", SITE, now_ns, lambda _: seen)
    with refused(Refusal.SERVER_CLOCK, "set the server's clock"):
        judge_batch(sent, "a", SITE, lambda: 1)


@pytest.mark.parametrize("lost_before", [0, 1, 2, 5])
def test_a_gap_is_taken_and_counted_where_all_of_it_is_declared_lost(lost_before):
    if lost_before < 2:
        with pytest.raises(GapError, match="sample 4 is expected"):
            admit(numbered(6, 2, lost_before=lost_before), 3)
    else:
        admission = admit(numbered(6, 2, lost_before=lost_before), 3)
        assert (numbers(admission), admission.lost, admission.watermark) == ([6, 7], 2, 7)


@pytest.mark.parametrize(
    ("first", "lost_before", "watermark", "expected"),
    [
        (8, 4, 3, (7, 4)),  # samples 4 to 7 are lost and none follow
        (8, 9, 3, (7, 4)),  # some came before
        (8, 3, 3, (3, 0)),  # 4 is not declared: may still come
        (4, 3, 3, (3, 0)),
        (2, 1, 3, (3, 0)),
    ],
)
def test_an_empty_batch_declares_samples_lost_that_none_follow(first, lost_before, watermark, expected):
    admission = admit(numbered(first, 0, lost_before=lost_before), watermark)
    assert (admission.watermark, admission.lost) == expected
    assert len(admission.batch.rows) == 0


EXTENT_M = 20_000.0


def plain(result):
    if isinstance(result, MessageError):
        return (result.reason, str(result), result.field, result.row)
    return (result.machine, result.spool_id, result.first_seq, result.frame, result.lost_before, result.rows.tobytes())


def one_by_one(payload: bytes):
    try:
        return decode_batch(payload, EXTENT_M)
    except MessageError as error:
        return error


def are_equal(payloads: list[bytes]) -> None:
    assert list(map(plain, decode_batches(payloads, EXTENT_M))) == [plain(one_by_one(each)) for each in payloads]


def beside(value: float, kind: type) -> list[float]:
    if kind is np.int64:
        return [value - 1, value, value + 1]
    return [np.nextafter(kind(value), kind(-np.inf)), value, np.nextafter(kind(value), kind(np.inf))]


def edges(name: str) -> list[float]:
    """Values around a column's limits."""
    kind = SAMPLE_DTYPE[name].type
    low, high = LIMITS.get(name, (-EXTENT_M, EXTENT_M))
    near = [*beside(low, kind), *beside(high, kind)]
    return near if kind is np.int64 else [*near, 0.0, -0.0, 1e-45, np.nan, np.inf, -np.inf]


@given(
    st.floats(0, 1e6, width=32) | st.sampled_from([0.0, 1e-45, 1e-30, 1e-6]),
    st.floats(0, 1e6, width=32) | st.sampled_from([0.0, 1e-45, 1e-30, 1e-6]),
    st.sampled_from([-1.0, 1.0]),
    st.integers(-40, 40),
)
def test_a_covariance_passes_exactly_where_it_passes_by_itself(xx, yy, sign, steps):
    xy = np.float32(sign * np.sqrt(np.float64(xx) * np.float64(yy)))
    for _ in range(abs(steps)):
        xy = np.nextafter(xy, np.float32(np.copysign(np.inf, steps)))
    are_equal([encode_batch(batch(samples(1, cov_xx_m2=xx, cov_yy_m2=yy, cov_xy_m2=xy), 1))])


@pytest.mark.parametrize("name", COLUMNS)
def test_each_limit_is_that_of_the_protocol(name):
    good = encode_batch(batch(samples(2), 1))
    verdicts = set()
    for value in edges(name):
        bad = samples(2)
        bad[name][1] = value
        payload = encode_batch(batch(bad, 1))
        are_equal([good, payload, good])
        verdicts.add(isinstance(one_by_one(payload), MessageError))
    assert verdicts == {True, False}


def test_refused_ones_leave_the_others_as_they_are():
    good = [encode_batch(batch(random_samples(n, n), 1 + n, f"m-{n}")) for n in (1, 7, 0, 300)]
    table = msgpack.unpackb(good[1])
    cols = table["cols"]
    bad = [
        b"",
        b"\xc1",
        msgpack.packb({**table, "v": 2}),
        msgpack.packb({**table, "n": 8}),
        msgpack.packb({**table, "machine": "../etc"}),
        msgpack.packb({**table, "cols": {**cols, "c_rr": cols["c_rr"][:-4]}}),
        msgpack.packb({**table, "cols": {**cols, "x_m": "text"}}),
        msgpack.packb({**table, "cols": {name: cols[name] for name in COLUMNS[:-3]}}),
        encode_batch(batch(samples(3, speed_mps=[0.0, 0.0, 101.0]), 1)),
    ]
    for i in range(len(bad) + 1):
        are_equal([*good[:2], *bad[:i], *good[2:], *bad[i:], good[0]])
    are_equal([])
    are_equal(bad)


CONFIG = FoldConfig()


def drive(draw: np.random.Generator, km: float, std_m: float, bend: float) -> Table:
    """A drive over new ground with position errors of up to 3 std."""
    n = round(2000 * km)
    driven, heading = draw.uniform(0.25, 0.75, n), draw.uniform(0, 6) + np.cumsum(draw.normal(0, bend, n))
    x_m, y_m = np.cumsum(driven * [np.cos(heading), np.sin(heading)], axis=1) + std_m * draw.uniform(-2.1, 2.1, (2, n))
    return samples(n, x_m=x_m, y_m=y_m, distance_m=driven, cov_xx_m2=std_m**2, cov_yy_m2=std_m**2)


def scattered(draw: np.random.Generator, n: int) -> Table:
    return samples(n, x_m=draw.uniform(-2e4, 2e4, n), y_m=draw.uniform(-2e4, 2e4, n), cov_xx_m2=8.9, cov_yy_m2=8.9)


def batches(rows: Table, draw: np.random.Generator) -> Iterator[Table]:
    while len(rows):
        n = int(2 ** draw.uniform(0, 12))
        yield rows[:n]
        rows = rows[n:]


def taken(credit: BlockCredit, rows: Table) -> int:
    """Samples accepted from a sender that halves refused batches, then drops refused samples."""
    try:
        credit.spend("a", rows)
    except MessageError:
        half = len(rows) // 2
        return taken(credit, rows[:half]) + taken(credit, rows[half:]) if half else 0
    return len(rows)


@pytest.mark.parametrize("bend", [0.0, 0.1])
@pytest.mark.parametrize(
    ("cell_m", "std_m", "km"), [(0.25, 2.9, 5), (1.0, 0.0, 50), (1.0, 0.8, 50), (1.0, 2.9, 50), (10.0, 2.9, 50)]
)
def test_an_honest_drive_is_taken_whole_with_gaps_and_jumps(cell_m: float, std_m: float, km: float, bend: float):
    draw = np.random.default_rng(1)
    rows, credit = drive(draw, km, std_m, bend), BlockCredit(cell_m, CONFIG, ())
    rows["x_m"] += (draw.random(len(rows)) < 1 / 400) * draw.uniform(-80, 80, len(rows))
    rows = rows[draw.random(len(rows)) < 0.98]
    assert all(taken(credit, part) == len(part) for part in batches(rows, draw))
    if (cell_m, std_m, bend) == (1.0, 0.8, 0.0):
        assert 4500 < len(credit.opened) < 7000, "50 km straight on, the most that honest driving opens"


@pytest.mark.parametrize("distance_m", [0.5, 100.0])
@pytest.mark.parametrize("stay", [0, 1, 10, 100])  # samples per place, to and fro by 2 m; 0: on a line, 85 m apart
@pytest.mark.parametrize("std_m", [2.9, 50.0])  # of every other sample; a large one has no vote
def test_whoever_scatters_opens_what_its_metres_pay_for(stay: int, distance_m: float, std_m: float):
    draw, n = np.random.default_rng(2), 2000
    rows, credit = scattered(draw, n), BlockCredit(1.0, CONFIG, ())
    for name, offset_m in (("x_m", 2.0 * (np.arange(n) % 2)), ("y_m", 0.0)):
        rows[name] = rows[name][np.arange(n) // stay * stay] + offset_m if stay else 60.0 * np.arange(n)
    rows["distance_m"], rows["cov_xx_m2"][::2] = distance_m, std_m**2
    for part in batches(rows, draw):
        taken(credit, part)
    driven_m = min(distance_m, 5.0) * n  # a sample per second
    assert len(credit.opened) <= 200 + (credit.jumps_per_m + credit.per_m) * driven_m
    assert len(credit.opened) <= 200 + 0.1 * driven_m or stay in (0, 100), "to and fro pays for no jumps"
    assert len(credit.opened) <= 200 or stay != 1, "and a jump earns nothing"


@pytest.mark.parametrize("cell_m", [0.5, 1.0, 7.0])
def test_the_grid_opens_no_block_that_is_not_paid_for(cell_m: float):
    rows = random_samples(400, seed=3, half_m=500.0, std_m=4.0)
    opened, paid = folded(rows, cell_m=cell_m).folded_since(-1)[0], set()
    for number in range(len(rows)):
        credit = BlockCredit(cell_m, CONFIG, ())
        credit.spend("a", rows[number : number + 1])
        paid |= credit.opened
    assert BlockCredit(cell_m, CONFIG, opened).opened <= paid
    assert len(paid) <= 1.5 * len(opened), "few more: corners where no vote falls"


def test_what_is_refused_earns_nothing_however_often_it_comes_but_driving_on_does():
    credit, liar = BlockCredit(1.0, CONFIG, ()), scattered(np.random.default_rng(4), 300)
    first = taken(credit, liar)
    assert {taken(credit, liar) for _ in range(20)} == {first}
    rows = samples(4000, x_m=5000 + 0.5 * np.arange(4000), y_m=0.0, distance_m=0.5)  # new ground, two blocks at a time
    assert 3500 < taken(credit, rows) < 4000


EVERYWHERE = [(x, y) for x in range(-320, 320) for y in range(-320, 320)]  # 10 x 10 km of known ground


@pytest.mark.parametrize("names", [1, 300])
@pytest.mark.parametrize("every_s", [0.001, 30.0])  # all in one time bucket, or in many
@pytest.mark.parametrize("known", [[], EVERYWHERE])
def test_memory_goes_with_what_was_driven(known: list[tuple[int, int]], every_s: float, names: int):
    draw, n = np.random.default_rng(5), 10_000
    rows, credit, taken_rows = scattered(draw, n), BlockCredit(1.0, CONFIG, known), []
    for name in ("x_m", "y_m"):
        rows[name] /= 4
    rows["stamp_ns"] += np.arange(n) * round(every_s * 1e9)
    for k in range(n):
        with contextlib.suppress(MessageError):
            credit.spend(f"machine-{k % names}", rows[k : k + 1])
            taken_rows.append(rows[k : k + 1])
    bytes_of_pages = sum(len(record) for *_, record in folded(np.concatenate(taken_rows)).state().blocks)
    assert 10**5 < bytes_of_pages < (10**7 if names == 1 else 3 * 10**8)


@pytest.mark.parametrize("signed", [False, True])
def test_a_fleet_of_any_size_goes_on_after_a_start_of_the_server(signed: bool):
    """Only names that are free, and of no machine that the journal knows, share one credit."""
    fleet = [f"machine-{k}" for k in range(2000)]
    credit, taken_rows = BlockCredit(1.0, CONFIG, (), [] if signed else fleet, signed=signed), Counter[str]()
    for number, machine in enumerate([*fleet, *(f"stranger-{k}" for k in range(2000))]):
        with contextlib.suppress(MessageError):
            credit.spend(machine, samples(1, x_m=100.0 * number), now_ns=1)
            taken_rows[machine.partition("-")[0]] += 1
    assert taken_rows["machine"] == 2000
    assert (taken_rows["stranger"] == 2000) == signed
    assert taken_rows["stranger"] > 100


@pytest.mark.parametrize(
    ("mps", "hz", "std_m"), [(25.0, 5.0, 2.9), (8.0, 4.0, 0.8), (0.05, 0.1, 2.0), (0.0, 0.02, 8.0)]
)
@pytest.mark.parametrize("known", [[], EVERYWHERE])
def test_no_honest_machine_meets_it_fast_or_slow(known: list[tuple[int, int]], mps: float, hz: float, std_m: float):
    """The last is parked with wandering positions: 0.5 m per sample that its wheels did not drive."""
    draw, n = np.random.default_rng(6), 10_000
    heading, step_m = np.cumsum(draw.normal(0, 0.02, n)), mps / hz
    x_m, y_m = np.cumsum(step_m * np.stack([np.cos(heading), np.sin(heading)]), axis=1) + draw.normal(0, std_m, (2, n))
    rows = samples(n, x_m=x_m, y_m=y_m, distance_m=max(step_m, 0.01), cov_xx_m2=std_m**2, cov_yy_m2=std_m**2)
    rows["stamp_ns"] += (np.arange(n) / hz * 1e9).astype(np.int64)
    credit = BlockCredit(1.0, CONFIG, known)
    for part in batches(rows, draw):
        credit.spend("a", part, now_ns=int(part["stamp_ns"][-1]))
