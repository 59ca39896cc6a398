"""Damaged files: bits flipped, cut, doubled, overwritten; texts edited by line and word."""

from __future__ import annotations

import re
from collections.abc import Sequence

from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy

_CHUNKS = (
    *(b"\x00", b"\xff\xff\xff\xff", b"\x00" * 64, b"\xdd\xff\xff\xff\xff"),
    *(b"\n", b'"', b"[" * 3000, b"\xef\xbb\xbf"),
)
_WORD = re.compile(r"[\w.+-]+|\"[^\"\n]*\"|\s+|.", re.DOTALL)
_PLAIN = (
    *("", "0", "-1", "1", "1e308", "-1e308", "1e-320", "1e999"),
    *("nan", "inf", "-inf", "NaN", "Infinity", "null", "true"),
    *("9223372036854775808", "18446744073709551616", "1" + "0" * 400, "1" * 5000, "0x" + "f" * 5000, "1_000", "٣"),
    *('""', '"a\\nb"', "'x\ny'", "a\nb", "\x00", "\u2028", "\x1b[0m", "*", "..", "a/b", "ä", "x" * 70, "y" * 3000),
    *("[]", "{}", "[[1, 2]]", "[" * 2000, "{a=" * 500, "[" * 500 + "]" * 500, '{"a":' * 2000),
    *("1979-05-27T07:32:00Z", "0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-12:00", "07:32:00", "1979-05-27"),
    *("%00", "%0A", "%ff", "%", "a%3Bb%3Dc", "=", ";", ",", ",,,,"),
)
_STRINGS = (
    *('"../log/imu-1.csv"', '"/dev/zero"', '""', '"\\u0000"', '"a\\nb"', '"*"', '"/"'),
    *('"' + "x" * 3000 + '"', '"nan"', '["a", 1]'),
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
    """Damaged copies of files."""

    @st.composite
    def strategy(draw: DrawFn) -> bytes:
        data = draw(st.sampled_from(seeds))
        for _ in range(draw(st.integers(1, 3))):
            data = draw(damaged(data))
        return data

    return strategy()


def texts(seeds: Sequence[bytes]) -> SearchStrategy[bytes]:
    """Edited copies of UTF-8 texts, some damaged as bytes too."""

    @st.composite
    def strategy(draw: DrawFn) -> bytes:
        text = draw(st.sampled_from(seeds)).decode()
        for _ in range(draw(st.integers(1, 3))):
            text = _edited(draw, text)
        data = text.encode()
        return draw(damaged(data)) if draw(st.integers(0, 3)) == 0 else data

    return strategy()


def _edited(draw: DrawFn, text: str) -> str:
    match draw(st.sampled_from(("value", "value", "word", "word", "line"))):
        case "value":
            return _with_value(draw, text)
        case "word":
            return _with_word(draw, text)
    return _with_line(draw, text)


def _with_value(draw: DrawFn, text: str) -> str:
    """Give one key another value."""
    lines = text.split("\n")
    assigned = [i for i, line in enumerate(lines) if "=" in line]
    if not assigned:
        return _with_word(draw, text)
    at = draw(st.sampled_from(assigned))
    key, _, _ = lines[at].partition("=")
    lines[at] = f"{key}= {draw(st.sampled_from((*_PLAIN, *_STRINGS)))}"
    return "\n".join(lines)


def _with_word(draw: DrawFn, text: str) -> str:
    """Replace, drop or double a word or sign."""
    words = _WORD.findall(text)
    if not words:
        return draw(st.sampled_from(_PLAIN))
    at = draw(st.integers(0, len(words) - 1))
    what = draw(st.sampled_from(("nasty", "nasty", "drop", "twice", "other")))
    new = {"drop": "", "twice": words[at] * 2, "other": words[draw(st.integers(0, len(words) - 1))]}
    words[at] = draw(st.sampled_from(_PLAIN)) if what == "nasty" else new[what]
    return "".join(words)


def _with_line(draw: DrawFn, text: str) -> str:
    """Drop, double or move a line."""
    lines = text.split("\n")
    at = draw(st.integers(0, len(lines) - 1))
    line = lines.pop(at)
    for _ in range(draw(st.sampled_from((0, 1, 2)))):
        lines.insert(draw(st.integers(0, len(lines))), line)
    return "\n".join(lines)
