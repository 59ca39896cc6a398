"""Files and messages whose bytes are damaged: bits flipped, cut, doubled, overwritten."""

from __future__ import annotations

from collections.abc import Sequence

from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

_CHUNKS = (
    b"\x00",
    b"\xff\xff\xff\xff",
    b"\x00" * 64,
    b"\xdd\xff\xff\xff\xff",
    b"\n",
    b'"',
    b"[" * 3000,
    b"\xef\xbb\xbf",
)


@st.composite
def damaged(draw: DrawFn, data: bytes) -> bytes:
    """One damage."""
    at = draw(st.integers(0, len(data)))
    match draw(st.sampled_from(("flip", "cut", "insert", "overwrite", "twice", "other"))):
        case "flip" if at < len(data):
            return data[:at] + bytes([data[at] ^ (1 << draw(st.integers(0, 7)))]) + data[at + 1 :]
        case "cut":
            return data[:at]
        case "insert":
            return data[:at] + draw(st.sampled_from(_CHUNKS)) + data[at:]
        case "overwrite":
            chunk = draw(st.sampled_from(_CHUNKS))
            return data[:at] + chunk + data[at + len(chunk) :]
        case "twice":
            return data[:at] + data[draw(st.integers(0, at)) :]
        case "other":
            return draw(st.binary(max_size=200))
    return data


def files(seeds: Sequence[bytes]) -> SearchStrategy[bytes]:
    """Damaged copies of these files."""

    @st.composite
    def strategy(draw: DrawFn) -> bytes:
        data = draw(st.sampled_from(seeds))
        for _ in range(draw(st.integers(1, 3))):
            data = draw(damaged(data))
        return data

    return strategy()
