"""SQLite's write-ahead log, read to its end: distinguishes damage in the middle from a torn tail.

SQLite recovers up to the first unsound frame and silently drops the rest. That suits power cuts, which may leave any
part of the last, unsynced transaction. But with `synchronous=FULL` a transaction starts only once the one before is on
disk. So a sound frame that continues a commit beyond the first unsound frame proves damage.

Format: https://sqlite.org/fileformat2.html#walformat, a header of 32 bytes, then frames of 24 bytes and a page. Frames
have the header's salts and a checksum that continues the frame before. Each is compared with the *stored* one, so it
stands for itself. Leftovers of rolled-back transactions never continue another's commit soundly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from protocol.arrays import AnyArray, Bools

HEADER, FRAME_HEADER = 32, 24
_MAGIC = 0x377F0682  # lowest bit set: checksums over big-endian words
_WORD_ORDERS = ("<u4", ">u4")
_PAGE_SIZES = tuple(2**n for n in range(9, 17))
_SALTS = slice(8, 16)  # in a frame's header
_FRAMES_AT_ONCE = 1000


@dataclass(frozen=True)
class LogScan:
    """A log's contents. frames: of its current use; recovered: taken by SQLite.

    damaged_at: byte of the first unsound frame, or 0 for the header, with transactions beyond it; None for a whole log
    or torn tail.
    """

    frames: int = 0
    recovered: int = 0
    damaged_at: int | None = None


def scan(log: bytes) -> LogScan:
    """Scan a log that nobody is writing."""
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
    """Such a log is ignored by SQLite; frames of any size show lost transactions."""
    for page in _PAGE_SIZES:
        second = HEADER + FRAME_HEADER + page
        for order in _WORD_ORDERS:
            for at in (HEADER, second):  # the salt of either of the first two frames
                held = _scan_frames(log, page, order, log[at : at + FRAME_HEADER][_SALTS], None)
                if held.damaged_at is not None:
                    return LogScan(held.frames, 0, 0)
    return LogScan()


def _scan_frames(log: bytes, page: int, order: str, salts: bytes, before: AnyArray | None) -> LogScan:
    """Scan frames; before: the header's checksum, None if damaged."""
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
    first = int(np.append(is_sound, False).argmin())  # first unsound frame
    recovered = int(is_commit[:first].nonzero()[0].max(initial=-1)) + 1
    stands_on_commit = (is_commit[:-1] & is_sound[1:])[first:].any()
    return LogScan(n, recovered, HEADER + first * size if stands_on_commit else None)


def _are_sound(frames: AnyArray, order: str, before: AnyArray | None) -> Iterator[Bools]:
    """Whether each frame's checksum continues the stored one before it; in pieces."""
    stored = np.ascontiguousarray(frames[:, 16:24]).view(">u4").astype(np.uint32)
    first = before if before is not None else ~stored[:1].ravel()
    earlier = np.concatenate([first[None, :], stored[:-1]])
    for at in range(0, len(frames), _FRAMES_AT_ONCE):
        piece = slice(at, at + _FRAMES_AT_ONCE)
        summed = np.concatenate([frames[piece, :8], frames[piece, FRAME_HEADER:]], axis=1)
        words = summed.view(order).astype(np.uint32)
        sound: Bools = (_checksums(words, earlier[piece]) == stored[piece]).all(axis=1)
        yield sound


def _checksums(words: AnyArray, before: AnyArray) -> AnyArray:
    """Checksums (n, 2) of rows of words (n, 2 k), continuing `before` (n, 2), modulo 2**32.

    SQLite's s0 += x0 + s1, s1 += x1 + s0 is, with M = ((1, 1), (1, 2)), s = M^k before + sum of M^(k-1-i) (x0, x0 +
    x1): a weight per word.
    """
    weights, power = _weights(words.shape[1] // 2)
    sums: AnyArray = words @ weights + before @ power
    return sums


@lru_cache(maxsize=4)
def _weights(pairs: int) -> tuple[AnyArray, AnyArray]:
    """Weights (2 pairs, 2), and M^pairs (2, 2)."""
    weights = np.empty((2 * pairs, 2), np.uint32)
    a, b, d = 1, 0, 1  # M^k = ((a, b), (b, d)): Fibonacci numbers
    for pair in range(pairs - 1, -1, -1):
        weights[2 * pair] = (a + b) % 2**32, (b + d) % 2**32
        weights[2 * pair + 1] = b, d
        a, b, d = (a + b) % 2**32, (b + d) % 2**32, (b + 2 * d) % 2**32
    return weights, np.array([[a, b], [b, d]], np.uint32)
