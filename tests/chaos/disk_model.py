"""A disk that loses power: surviving bytes after writes, syncs and renames.

Synced data survives. Each unsynced write may survive fully, in sectors, or not, in any order. Name changes keep their
order, and any sync makes earlier ones durable, as on journalling file systems (ext4, XFS).
"""

from __future__ import annotations

import random
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path

SECTOR = 512
_HEADER = struct.Struct("<qqqq")


class Kind(IntEnum):
    """Operations, numbered as in disk_shim.c."""

    WRITE = 1
    TRUNCATE = 2
    SYNC = 3
    UNLINK = 4
    RENAME = 5
    CREATE = 6


@dataclass(frozen=True)
class Operation:
    """data: bytes written, or the new name."""

    kind: Kind
    name: str
    offset: int
    data: bytes


def read_trace(path: Path) -> Iterator[Operation]:
    """Operations recorded by the shim."""
    text, at = path.read_bytes(), 0
    while at + _HEADER.size <= len(text):
        kind, name_n, offset, n = _HEADER.unpack_from(text, at)
        at += _HEADER.size
        has_bytes = kind in (Kind.WRITE, Kind.RENAME)
        name, data = text[at : at + name_n], text[at + name_n : at + name_n + n] if has_bytes else b""
        at += name_n + len(data)
        yield Operation(Kind(kind), name.decode(), offset, data)


@dataclass
class _File:
    """Durable bytes, and operations since the last sync."""

    durable: bytearray = field(default_factory=bytearray)
    pending: list[Operation] = field(default_factory=list)

    def sync(self) -> None:
        for operation in self.pending:
            _apply(self.durable, operation, operation.data)
        self.pending.clear()


class Disk:
    def __init__(self) -> None:
        self._names: dict[str, _File] = {}
        self._was: list[dict[str, _File]] = [{}]  # names since the last sync, durable ones first

    def do(self, operation: Operation) -> None:
        name = operation.name
        if operation.kind == Kind.SYNC:
            if name in self._names:
                self._names[name].sync()
            self._was = [dict(self._names)]
        elif operation.kind in (Kind.WRITE, Kind.TRUNCATE):
            self._names.setdefault(name, _File()).pending.append(operation)
        else:
            self._rename(operation)
            self._was.append(dict(self._names))

    def cut(self, rng: random.Random, folder: Path) -> None:
        """Write a possible state after a power cut into an empty folder."""
        for name, file in rng.choice(self._was).items():
            image, share = bytearray(file.durable), rng.choice((0.0, 0.5, 0.9, 1.0))
            for operation in file.pending:
                if rng.random() < share:
                    _apply(image, operation, operation.data)
                elif rng.random() < 0.5:
                    _tear(image, operation, rng)
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(image)

    def _rename(self, operation: Operation) -> None:
        if operation.kind == Kind.CREATE:
            self._names[operation.name] = _File()
        elif (file := self._names.pop(operation.name, None)) and operation.kind == Kind.RENAME:
            self._names[operation.data.decode()] = file


def _apply(image: bytearray, operation: Operation, data: bytes) -> None:
    if operation.kind == Kind.TRUNCATE:
        del image[operation.offset :]
        image.extend(bytes(operation.offset - len(image)))
        return
    image.extend(bytes(max(0, operation.offset - len(image))))
    image[operation.offset : operation.offset + len(data)] = data


def _tear(image: bytearray, operation: Operation, rng: random.Random) -> None:
    """Write some sectors of one write."""
    for at in range(0, len(operation.data), SECTOR):
        if rng.random() < 0.5:
            _apply(image, Operation(Kind.WRITE, "", operation.offset + at, b""), operation.data[at : at + SECTOR])
