"""Batches decoded together: what comes of them is what the codec says of each one by itself."""

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapserver.ingest.batches import decode_batches
from protocol.errors import MessageError
from protocol.machine.samples import COLUMNS, LIMITS, SAMPLE_DTYPE
from protocol.wire.codec import decode_batch, encode_batch
from tests.unit.mapserver.data import batch, random_samples, samples

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
    """A value and its neighbours."""
    if kind is np.int64:
        return [value - 1, value, value + 1]
    return [np.nextafter(kind(value), kind(-np.inf)), value, np.nextafter(kind(value), kind(np.inf))]


def edges(name: str) -> list[float]:
    """Values of a column around all that decides."""
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
    """Around the border of what is positive semidefinite, step by step of single precision."""
    xy = np.float32(sign * np.sqrt(np.float64(xx) * np.float64(yy)))
    for _ in range(abs(steps)):
        xy = np.nextafter(xy, np.float32(np.copysign(np.inf, steps)))
    are_equal([encode_batch(batch(samples(1, cov_xx_m2=xx, cov_yy_m2=yy, cov_xy_m2=xy), 1))])


@pytest.mark.parametrize("name", COLUMNS)
def test_each_limit_is_that_of_the_protocol(name):
    """Not by a hair more or less, whatever the column, alone and beside a good batch."""
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
    """Malformed in any way, implausible, empty, and long: whatever stands before and behind."""
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
