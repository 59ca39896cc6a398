"""Valid MessagePack messages with hostile edits: fields dropped, retyped, nested, doubled; columns cut and swapped.

Messages become trees whose maps are lists of pairs, to allow duplicate keys; `Raw` leaves are verbatim bytes, so
headers can lie.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import msgpack
import numpy as np
from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

from tests.fuzz.mutations import damaged


class MapNode(list[list[Any]]):
    """Pairs of key and value."""


class Raw(bytes):
    """Verbatim bytes."""


_CLAIM = b"\xff\xff\xff\xff"
NASTY: tuple[Any, ...] = (
    *(None, True, False, [], [[]], MapNode(), b"", b"\xff" * 8, "", "a\nb\x1b[0m", "*", "x" * 70, "ä\u2028", "1"),
    *(0, 1, 2, -1, 20_001, 2**62, 2**62 + 1, 2**63, 2**64 - 1, -(2**63), 4_102_444_800_000_000_001),
    *(float("nan"), float("inf"), -float("inf"), 1e308, -0.0, 5e-324),
    *(Raw(b"\x91" * depth + b"\x01") for depth in (20, 600, 2000)),
    *(Raw(b"\x81\xa1v" * depth + b"\x01") for depth in (20, 600)),
    *(Raw(header + _CLAIM) for header in (b"\xdd", b"\xdf", b"\xc6", b"\xdb", b"\xc9")),
    Raw(b"\xdd\x00\x01\x86\xa0" * 1000),  # a thousand nested lists, each claiming 100,000 items
    Raw(b"\xdc\xff\xff"),
    Raw(b"\xd6\xff\xff\xff\xff\xff"),  # a timestamp, no plain value
    Raw(b"\xd4\x05\x00"),  # an extension type
    Raw(b"\xa2\xff\xfe"),  # invalid UTF-8
    Raw(b"\xc1"),  # reserved
)
_KEYS: tuple[Any, ...] = ("v", "n", "cols", "zzz", "", "a\nb", "k" * 5000, b"n", 1, None, Raw(b"\x90"))
_ELEMENTS = {
    4: tuple(np.array(v, "<f4").tobytes() for v in (np.nan, np.inf, -np.inf, -1.0, 3e38, 1e-45)),
    8: (
        *(np.array(v, "<f8").tobytes() for v in (np.nan, np.inf, 1e308, -1e5, 5e-324)),
        *(np.array(v, "<i8").tobytes() for v in (0, -1, 2**63 - 1, -(2**63))),
    ),
}


def messages(seeds: Sequence[bytes]) -> SearchStrategy[bytes]:
    """Edited copies of messages, some damaged as bytes too."""

    @st.composite
    def strategy(draw: DrawFn) -> bytes:
        root = [_tree(msgpack.unpackb(draw(st.sampled_from(seeds))))]
        for _ in range(draw(st.integers(1, 3))):
            _edit(draw, root)
        data = pack_tree(root[0])
        return draw(damaged(data)) if draw(st.integers(0, 3)) == 0 else data

    return strategy()


def pack_tree(node: Any) -> bytes:
    """A tree as bytes, even outside of MessagePack."""
    if isinstance(node, Raw):
        return bytes(node)
    if isinstance(node, MapNode):
        return _header(0x80, b"\xdf", len(node)) + b"".join(pack_tree(part) for pair in node for part in pair)
    if isinstance(node, list):
        return _header(0x90, b"\xdd", len(node)) + b"".join(map(pack_tree, node))
    packed: bytes = msgpack.packb(node)
    return packed


def _header(short: int, long: bytes, n: int) -> bytes:
    return bytes([short | n]) if n < 16 else long + n.to_bytes(4, "big")


def _tree(value: Any) -> Any:
    if isinstance(value, dict):
        return MapNode([key, _tree(inner)] for key, inner in value.items())
    return [_tree(inner) for inner in value] if isinstance(value, list) else value


def _places(node: Any) -> list[tuple[list[Any], int]]:
    """Every value of a tree, as its list and index."""
    places: list[tuple[list[Any], int]] = []
    if isinstance(node, list) and not isinstance(node, MapNode):
        places += [(node, i) for i in range(len(node))]
    for pair in node if isinstance(node, MapNode) else ():
        places.append((pair, 1))
    below = (holder[i] for holder, i in list(places))
    return places + [place for part in below if isinstance(part, list) for place in _places(part)]


def _maps(node: Any) -> list[MapNode]:
    parts = node if isinstance(node, list) else []
    below = [inner for part in parts for inner in _maps(part)]
    return [node, *below] if isinstance(node, MapNode) else below


def _nasty(draw: DrawFn) -> Any:
    """A hostile value of its own: later edits change it in place, and could put a shared one into itself."""
    return deepcopy(draw(st.sampled_from(NASTY)))


def _edit(draw: DrawFn, root: list[Any]) -> None:
    """Change one thing of a tree in place."""
    maps = [each for each in _maps(root) if each]
    if maps and draw(st.booleans()):
        _edit_map(draw, draw(st.sampled_from(maps)))
        return
    holder, i = draw(st.sampled_from(_places(root)))
    value = holder[i]
    if isinstance(value, bytes) and not isinstance(value, Raw) and draw(st.integers(0, 3)):
        holder[i] = _column(draw, value)
    elif draw(st.integers(0, 5)) == 0:
        holder[i] = MapNode([["v", value]]) if draw(st.booleans()) else [value] * draw(st.sampled_from((1, 2, 30)))
    else:
        holder[i] = _nasty(draw)


def _edit_map(draw: DrawFn, table: MapNode) -> None:
    at = draw(st.integers(0, len(table) - 1))
    match draw(st.sampled_from(("drop", "rename", "twice", "more"))):
        case "drop":
            del table[at]
        case "rename":
            table[at] = [draw(st.sampled_from(_KEYS)), table[at][1]]
        case "twice":
            table.append([table[at][0], _nasty(draw)])
        case "more":
            table.append([draw(st.sampled_from(_KEYS)), _nasty(draw)])


def _column(draw: DrawFn, data: bytes) -> bytes:
    """A column that is cut, too long, byte-swapped, or has one impossible number."""
    width = draw(st.sampled_from((4, 8)))
    what = draw(st.sampled_from(("cut", "longer", "swapped", "number")))
    if what == "cut":
        return data[: draw(st.integers(0, len(data)))]
    if what == "longer":
        return data + bytes(draw(st.sampled_from((1, 4, 8, 4096))))
    if len(data) < width or len(data) % width:
        return data[1:]
    if what == "swapped":
        return np.frombuffer(data, f"<u{width}").byteswap().tobytes()
    at = draw(st.integers(0, len(data) // width - 1)) * width
    return data[:at] + draw(st.sampled_from(_ELEMENTS[width])) + data[at + width :]
