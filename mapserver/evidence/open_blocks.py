"""Open blocks: evidence unpacked, for the fold to write into. It is packed into pages when its space is needed."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator

import numpy as np

from mapserver.evidence import cells as ev
from mapserver.evidence.pages import Page, pack
from mapserver.evidence.votes import HASH
from protocol.arrays import Bools, Ints

# Block columns and rows are packed as 18 bits each below the bucket, which has 27: enough for 5 cm cells 100 km away,
# and for minutes until the year 2100.
CODE_BITS = 18
CODE_HALF = 1 << (CODE_BITS - 1)
FREE = -1
_MASK = (1 << CODE_BITS) - 1


class NoRoom(Exception):  # noqa: N818 - the grid makes room: it is no error
    """So many blocks cannot be opened. blocks: how many."""

    def __init__(self, blocks: int) -> None:
        super().__init__(blocks)
        self.blocks = blocks


class OpenBlocks:
    """A fixed number of block buckets, zero when they are opened.

    counts: (slots, COUNTS, 256) uint32; planes: (slots, COUNTS) which of them have been written to; bitmaps:
    (slots, 2, 256) uint64; newest: (slots, 256) int64. Nothing saturates here: `load`, the weight of all votes since
    the last `drain`, stays within COUNT_MAX (see Grid.fold).
    keys, places: open-addressed hash table from code to slot, of a power of two entries, for kernels; a code's search
    begins at code * HASH >> shift (modulo 2**64).
    """

    def __init__(self, slots: int) -> None:
        self.counts = np.zeros((slots, ev.COUNTS, ev.CELLS), np.uint32)
        self.planes: Bools = np.zeros((slots, ev.COUNTS), np.bool_)
        self.bitmaps = np.zeros((slots, 2, ev.CELLS), np.uint64)
        self.newest = np.zeros((slots, ev.CELLS), np.int64)
        entries = 1 << (2 * slots).bit_length()
        self.keys = np.full(entries, FREE, np.int64)
        self.places = np.zeros(entries, np.int64)
        self.load = 0
        self.shift = 64 - (entries.bit_length() - 1)
        self._slots: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._slots)

    def slots_of(self, codes: Iterable[int]) -> Ints:
        """Slots of open blocks, FREE for those that are not open."""
        return np.array([self._slots.get(code, FREE) for code in codes], np.int64)

    def open(self, codes: Collection[int]) -> None:
        """Give each of these blocks a slot, or raise NoRoom before any has one."""
        if len(codes) > len(self.counts) - len(self._slots):
            raise NoRoom(len(codes))
        for code in codes:
            slot = self._slots[code] = len(self._slots)
            entry = ((code * HASH) & (2**64 - 1)) >> self.shift
            while self.keys[entry] != FREE:
                entry = (entry + 1) & (len(self.keys) - 1)
            self.keys[entry], self.places[entry] = code, slot

    def drain(self) -> Iterator[tuple[int, Page]]:
        """Pack all blocks; afterwards none is open."""
        slots, self._slots = self._slots, {}
        for code, slot in slots.items():
            page = pack(self.counts[slot], self.planes[slot], self.bitmaps[slot], self.newest[slot])
            if len(page.cells):
                yield code, page
        self.keys[:] = FREE
        self.load = 0


def code_of(bucket: Ints, x: Ints, y: Ints) -> Ints:
    """Code of a time bucket, block column and block row."""
    return (bucket << 2 * CODE_BITS) | ((x + CODE_HALF) << CODE_BITS) | (y + CODE_HALF)


def split_code(code: int) -> tuple[int, int, int]:
    """Undo `code_of`."""
    return code >> 2 * CODE_BITS, (code >> CODE_BITS & _MASK) - CODE_HALF, (code & _MASK) - CODE_HALF
