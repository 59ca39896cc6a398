"""Decodes the batches of a commit in one pass; refuses as `protocol.wire.codec.decode_batch` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numba
import numpy as np

from protocol.arrays import AnyArray, Floats32, Table
from protocol.errors import MessageError
from protocol.machine.samples import COLUMNS, LIMITS, NAN_ALLOWED, SAMPLE_DTYPE, check_samples, empty
from protocol.wire.codec import unpack_batch
from protocol.wire.messages import PackedBatch, SampleBatch

# rows as 32-bit words: a stamp and two coordinates of two words, then float32
_WORD = np.dtype("<u4")
_WIDTHS = np.array([SAMPLE_DTYPE[name].itemsize // _WORD.itemsize for name in COLUMNS])
_WORDS = int(_WIDTHS.sum())
_SINGLE = [name for name in COLUMNS if SAMPLE_DTYPE[name] == np.float32]
_FIRST_SINGLE = _WORDS - len(_SINGLE)
_LOW, _HIGH = (np.array([LIMITS[name][end] for name in _SINGLE], np.float32) for end in (0, 1))
_FIRST_NS, _LAST_NS = LIMITS["stamp_ns"]
_XX, _XY, _YY = (_FIRST_SINGLE + _SINGLE.index(name) for name in ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2"))
# bits of columns that may be NaN, only as a group
_NAN_GROUPS = tuple(sum(1 << _SINGLE.index(name) for name in names) for names in NAN_ALLOWED)
_NAN_ALLOWED = sum(_NAN_GROUPS)


def decode_batches(payloads: Sequence[bytes], extent_m: float) -> list[SampleBatch | MessageError]:
    """Decode and check batches; returns batches or errors. Rows share one table. extent_m: most from the origin."""
    unpacked = [_unpack(payload) for payload in payloads]
    packed = [batch for batch in unpacked if isinstance(batch, PackedBatch)]
    table, plausible = _decode(packed, extent_m)
    ends = np.cumsum([batch.n for batch in packed]).tolist()
    decoded = iter(
        _batch(batch, table[end - batch.n : end], extent_m, is_plausible)
        for batch, end, is_plausible in zip(packed, ends, plausible, strict=True)
    )
    return [next(decoded) if isinstance(batch, PackedBatch) else batch for batch in unpacked]


def warm_up() -> None:
    """Compile the kernels, or load them, before a batch waits for them."""
    columns = tuple(bytes(SAMPLE_DTYPE[name].itemsize) for name in COLUMNS)
    one = PackedBatch(SampleBatch("", 1, 1, empty(), ""), 1, columns)
    _decode([one], 1.0)


def _unpack(payload: bytes) -> PackedBatch | MessageError:
    try:
        return unpack_batch(payload)
    except MessageError as error:
        return error


def _decode(packed: Sequence[PackedBatch], extent_m: float) -> tuple[Table, list[bool]]:
    """Rows of all batches, and which batches are plausible."""
    lengths = np.array([batch.n for batch in packed], np.int64)
    columns = b"".join(chain.from_iterable(batch.columns for batch in packed))
    words: AnyArray = np.empty((int(lengths.sum()), _WORDS), _WORD)
    _interleave(np.frombuffer(columns, _WORD), lengths, words)
    table: Table = words.view(SAMPLE_DTYPE)[:, 0]
    plausible = np.empty(len(packed), np.bool_)
    _judge(table, words.view("<f4"), lengths, extent_m, plausible)
    return table, plausible.tolist()


def _batch(batch: PackedBatch, rows: Table, extent_m: float, is_plausible: bool) -> SampleBatch | MessageError:  # noqa: FBT001
    if not is_plausible:
        try:
            check_samples(rows, extent_m)  # names field and row
        except MessageError as error:
            return error
    return replace(batch.batch, rows=rows)


@numba.njit(cache=True, nogil=True)
def _interleave(columns: Any, lengths: Any, out: Any) -> None:
    """Transpose consecutive batches' columns to rows (n, words)."""
    at, first = 0, 0
    for n in lengths:
        word = 0
        for width in _WIDTHS:
            for i in range(n):
                for j in range(width):
                    out[first + i, word + j] = columns[at]
                    at += 1
            word += width
        first += n


@numba.njit(cache=True, nogil=True)
def _judge(rows: Any, singles: Floats32, lengths: Any, extent_m: float, plausible: Any) -> None:
    """Whether batches pass `check_samples`; singles: the same rows as float32."""
    k = 0
    for batch in range(len(lengths)):
        plausible[batch] = True
        for _ in range(lengths[batch]):
            plausible[batch] &= _is_plausible(rows[k], singles[k], extent_m)
            k += 1


@numba.njit(cache=True, nogil=True)
def _is_plausible(row: Any, singles: Floats32, extent_m: float) -> bool:
    unknown = 0
    inside = _FIRST_NS <= row.stamp_ns <= _LAST_NS
    for value in (row.x_m, row.y_m):
        inside &= np.isfinite(value) and abs(value) <= extent_m
    for j in range(len(_LOW)):
        value = singles[_FIRST_SINGLE + j]
        unknown |= np.isnan(value) << j
        inside &= not (value < _LOW[j] or value > _HIGH[j])
    partly = False
    for group in _NAN_GROUPS:
        partly |= unknown & group not in (0, group)
    xx, xy, yy = np.float64(singles[_XX]), np.float64(singles[_XY]), np.float64(singles[_YY])
    semidefinite = xx * yy - xy * xy >= -1e-6 * max(xx * yy, 1e-12)
    return bool(inside and semidefinite and not partly and not unknown & ~_NAN_ALLOWED)
