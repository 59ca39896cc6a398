"""Corrections of base stations to bytes and back, with full validation."""

from protocol.errors import MessageError, Refusal
from protocol.machine.readings import Correction, columns, parse_reading
from protocol.wire.codec import MAX_SMALL_BYTES, pack, take, take_name, take_stamp, unpack
from protocol.wire.messages import SiteCorrection


def encode_correction(message: SiteCorrection) -> bytes:
    """What a base station says of its site's GPS errors."""
    correction = message.correction
    values = {name: getattr(correction, name) for name in columns(Correction.kind)}
    return pack({"base": correction.sensor, "frame": message.frame, "stamp_ns": correction.stamp_ns, **values})


def decode_correction(data: bytes, frame: str) -> SiteCorrection:
    """Undo `encode_correction`; refused where a value is not plausible, or is of another frame than this one."""
    table = unpack(data, MAX_SMALL_BYTES)
    base, stamp_ns, of_base = take_name(table, "base"), take_stamp(table), take(table, "frame", str)
    if of_base != frame:
        problem = (
            f"corrections of {base} are in frame {of_base[:40]!r}, this site's is {frame!r}: compare the site files"
        )
        raise MessageError(Refusal.WRONG_FRAME, problem, field="frame")
    values = tuple(take(table, name, float) for name in columns(Correction.kind))
    correction = parse_reading(Correction.kind, base, stamp_ns, values)
    assert isinstance(correction, Correction)
    return SiteCorrection(of_base, correction)
