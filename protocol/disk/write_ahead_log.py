"""SQLite's write-ahead log, looked at to its end: damage in the middle is told from a torn tail.

SQLite recovers a log up to the first frame that is not sound, and drops what follows without a word. That is right
for a power cut, which may leave any part of the last, unsynced transaction, also later frames without earlier ones.
But with `synchronous=FULL` a transaction begins only once the one before it is on disk. So a frame that follows soundly
on a commit beyond the first unsound frame proves that this commit was on disk, and that the log was damaged since.

The format is that of https://sqlite.org/fileformat2.html#walformat: a header of 32 bytes, then frames of 24 bytes and a
page. Each frame has the salts of the header, and a checksum that begins with that of the frame before. A frame is
compared with the checksum that the frame before has *stored*, so each stands for itself. What transactions that were
rolled back left behind the end never follows soundly on another's commit: the checksums before it differ.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from protocol.arrays import AnyArray, Bools

HEADER, FRAME_HEADER = 32, 24
_MAGIC = 0x377F0682  # its lowest bit is set where checksums are over big-endian words
_WORD_ORDERS = ("<u4", ">u4")
_PAGE_SIZES = tuple(2**n for n in range(9, 17))
_SALTS = slice(8, 16)  # in the header of a frame
_FRAMES_AT_ONCE = 1000


@dataclass(frozen=True)
class LogScan:
    """What a log holds. frames: of its present use; recovered: how many of them SQLite takes.

    damaged_at: byte of the first unsound frame, or 0 for the header, where transactions were on disk beyond it; None
    for a log that is whole or has a torn tail.
    """

    frames: int = 0
    recovered: int = 0
    damaged_at: int | None = None


def scan(log: bytes) -> LogScan:
    """Look at the bytes of a log. Nobody may be writing it meanwhile."""
    if len(log) < HEADER:
        return LogScan()
    words = np.frombuffer(log[:HEADER], ">u4")
    magic, page = int(words[0]), int(words[2])
    if magic & ~1 == _MAGIC and page in _PAGE_SIZES:
        order = _WORD_ORDERS[magic & 1]
        start = _checksums(
            np.frombuffer(log[:FRAME_HEADER], order).astype(np.uint32)[None, :], np.zeros((1, 2), np.uint32)
        )
        if (start[0] == words[6:8]).all():
            return _scan_frames(log, page, order, log[16:24], words[6:8].astype(np.uint32))
    return _without_header(log)


def _without_header(log: bytes) -> LogScan:
    """SQLite takes nothing of such a log: whether it had anything shows by frames alone, whatever their size."""
    for page in _PAGE_SIZES:
        second = HEADER + FRAME_HEADER + page
        for order in _WORD_ORDERS:
            for at in (HEADER, second):  # the salt of either of the first two frames
                held = _scan_frames(log, page, order, log[at : at + FRAME_HEADER][_SALTS], None)
                if held.damaged_at is not None:
                    return LogScan(held.frames, 0, 0)
    return LogScan()


def _scan_frames(log: bytes, page: int, order: str, salts: bytes, before: AnyArray | None) -> LogScan:
    """before: the checksum of the header, None where that is damaged."""
    size = FRAME_HEADER + page
    n = (len(log) - HEADER) // size
    if n < 1 or len(salts) < 8:
        return LogScan()
    frames = np.frombuffer(log, np.uint8, n * size, HEADER).reshape(n, size)
    is_present: Bools = np.all(frames[:, _SALTS] == np.frombuffer(salts, np.uint8), axis=1)
    n = int(is_present.nonzero()[0].max(initial=-1)) + 1
    if n < 1:
        return LogScan()
    frames, is_present = frames[:n], is_present[:n]
    is_sound = is_present & np.concatenate([*_are_sound(frames, order, before), np.zeros(0, np.bool_)])
    is_commit: Bools = np.any(frames[:, 4:8], axis=1)
    first = int(np.append(is_sound, False).argmin())  # that is not sound
    recovered = int(is_commit[:first].nonzero()[0].max(initial=-1)) + 1
    stands_on_commit = (is_commit[:-1] & is_sound[1:])[first:].any()
    return LogScan(n, recovered, HEADER + first * size if stands_on_commit else None)


def _are_sound(frames: AnyArray, order: str, before: AnyArray | None) -> Iterator[Bools]:
    """Whether each frame has the checksum that follows from the one stored before it; in pieces."""
    stored = np.ascontiguousarray(frames[:, 16:24]).view(">u4").astype(np.uint32)
    first = before if before is not None else ~stored[:1].ravel()  # nothing follows on a damaged header
    earlier = np.concatenate([first[None, :], stored[:-1]])
    for at in range(0, len(frames), _FRAMES_AT_ONCE):
        piece = slice(at, at + _FRAMES_AT_ONCE)
        summed = np.concatenate([frames[piece, :8], frames[piece, FRAME_HEADER:]], axis=1)
        words = summed.view(order).astype(np.uint32)
        sound: Bools = (_checksums(words, earlier[piece]) == stored[piece]).all(axis=1)
        yield sound


def _checksums(words: AnyArray, before: AnyArray) -> AnyArray:
    """Checksums (n, 2) of rows of words (n, 2 k), begun with `before` (n, 2); all modulo 2**32.

    SQLite adds pairs of words in turn, s0 += x0 + s1, s1 += x1 + s0: with M = ((1, 1), (1, 2)) that is
    s = M^k before + sum of M^(k-1-i) (x0, x0 + x1), so each word has a weight of its own.
    """
    weights, power = _weights(words.shape[1] // 2)
    sums: AnyArray = words @ weights + before @ power
    return sums


@lru_cache(maxsize=4)
def _weights(pairs: int) -> tuple[AnyArray, AnyArray]:
    """Weights (2 pairs, 2) of words, and M^pairs (2, 2)."""
    weights = np.empty((2 * pairs, 2), np.uint32)
    a, b, d = 1, 0, 1  # M^k = ((a, b), (b, d)): Fibonacci numbers
    for pair in range(pairs - 1, -1, -1):
        weights[2 * pair] = (a + b) % 2**32, (b + d) % 2**32
        weights[2 * pair + 1] = b, d
        a, b, d = (a + b) % 2**32, (b + d) % 2**32, (b + 2 * d) % 2**32
    return weights, np.array([[a, b], [b, d]], np.uint32)
