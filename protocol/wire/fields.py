"""Message fields: MessagePack with the protocol version; types and limits checked; MessageError."""

import math
import re
import zlib
from typing import Any

import msgpack

from protocol.errors import MessageError, Refusal
from protocol.machine.readings import MAX_STAMP_NS
from protocol.site.site_config import NAME
from protocol.wire.messages import VERSION

MAX_SMALL_BYTES = 64 * 2**10
MAX_DEPTH = 16  # of plain values
MAX_INT = 2**64 - 1  # of MessagePack
STORE_ID = re.compile(r"[0-9a-f]{16}")


def pack(table: dict[str, Any]) -> bytes:
    """MessagePack with the version first; integers are capped at 64 bits."""
    packed: bytes = msgpack.packb({"v": VERSION, **table}, default=_fitting)
    return packed


def _fitting(value: Any) -> int:
    """Cap sums of claimed losses, so that the others remain readable."""
    if type(value) is int and value > MAX_INT:
        return MAX_INT
    raise TypeError(f"{type(value).__name__} is no value of MessagePack")


def unpack(data: bytes, limit: int) -> dict[str, Any]:
    """Undo `pack`; refuses what is too long, no map, or another version.

    A list reserves memory for as many items as it claims, so all claims are checked against the bytes first.
    """
    if len(data) > limit:
        raise MessageError(Refusal.TOO_LARGE, f"{len(data)} bytes, at most {limit} are allowed")
    try:
        claims = msgpack.Unpacker(max_buffer_size=len(data))
        claims.feed(data)
        claims.skip()
        table = msgpack.unpackb(data)
    except (ValueError, TypeError, RecursionError, msgpack.UnpackException) as error:
        raise MessageError(Refusal.NOT_MSGPACK, f"not MessagePack, or cut off: {error}") from None
    if not isinstance(table, dict):
        raise MessageError(Refusal.NOT_MSGPACK, "not a MessagePack map")
    if (version := take(table, "v", int)) != VERSION:
        raise MessageError(
            Refusal.VERSION, f"{version}: this side speaks version {VERSION}; update the older side", field="v"
        )
    return table


def take(table: dict[str, Any], name: str, kind: type[Any], default: Any = None) -> Any:
    """Take a field of a type; a default makes it optional."""
    value: Any = table.get(name, default)
    if value is None:
        raise MessageError(Refusal.MISSING_FIELD, "missing", field=name)
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind:
        raise MessageError(Refusal.WRONG_TYPE, f"{kind.__name__} expected, not {type(value).__name__}", field=name)
    if kind is float and not math.isfinite(value):
        raise MessageError(Refusal.NOT_FINITE, f"{value} is not finite", field=name)
    return value


def check_plain(value: Any, field: str, depth: int = MAX_DEPTH) -> None:
    """Refuse bytes, MessagePack types, and nesting beyond `depth`."""
    if depth < 0:
        raise MessageError(Refusal.WRONG_TYPE, f"nested more than {MAX_DEPTH} deep", field=field)
    if isinstance(value, dict):
        for name, part in value.items():
            if type(name) is not str:
                raise MessageError(Refusal.WRONG_TYPE, f"the name {name!r:.40} is no text", field=field)
            check_plain(part, field, depth - 1)
    elif isinstance(value, list):
        for part in value:
            check_plain(part, field, depth - 1)
    elif not isinstance(value, str | int | float | None):
        raise MessageError(Refusal.WRONG_TYPE, f"{type(value).__name__} is no plain value", field=field)


def take_plain(table: dict[str, Any], name: str) -> dict[str, Any]:
    """Take a map of plain values, fit to show."""
    values: dict[str, Any] = take(table, name, dict)
    check_plain(values, name)
    return values


def take_int(table: dict[str, Any], name: str, low: int, high: int, reason: Refusal = Refusal.OUT_OF_RANGE) -> int:
    """Take an integer, limits included."""
    value: int = take(table, name, int)
    if not low <= value <= high:
        raise MessageError(reason, f"{value} is not between {low} and {high}", field=name)
    return value


def take_name(table: dict[str, Any], field: str = "machine") -> str:
    """Take a name."""
    name: str = take(table, field, str)
    if not NAME.fullmatch(name):
        raise MessageError(Refusal.OUT_OF_RANGE, f"{name[:70]!r} is not a name", field=field)
    return name


def take_store(table: dict[str, Any], name: str = "store", *, optional: bool = False) -> str:
    """Take a store id; empty if optional and missing."""
    text: str = take(table, name, str, "" if optional else None)
    if not STORE_ID.fullmatch(text) and (text or not optional):
        raise MessageError(Refusal.OUT_OF_RANGE, f"{text[:40]!r} is no id of a store", field=name)
    return text


def take_stamp(table: dict[str, Any]) -> int:
    """Take `stamp_ns`."""
    return take_int(table, "stamp_ns", 1, MAX_STAMP_NS)


def check(holds: bool, field: str, problem: str, reason: Refusal = Refusal.OUT_OF_RANGE) -> None:  # noqa: FBT001
    """Refuse a field if a condition fails."""
    if not holds:
        raise MessageError(reason, problem, field=field)


def inflated(data: bytes, size: int, field: str, row: int | None = None) -> bytes:
    """Inflate a field (zlib) of exactly `size` bytes; never more."""
    stream = zlib.decompressobj()
    try:
        plain = stream.decompress(data, size + 1)
    except zlib.error as error:
        raise MessageError(Refusal.WRONG_TYPE, f"not deflated: {error}", field=field, row=row) from None
    if len(plain) != size or not stream.eof:
        problem = f"{len(plain)} bytes deflated, {size} are expected"
        raise MessageError(Refusal.COLUMN_LENGTH, problem, field=field, row=row)
    return plain
