"""Corrections for receivers to bytes and back. That the frames are whole is for whoever writes them to a receiver."""

from protocol.errors import MessageError, Refusal, one_line
from protocol.wire.codec import pack, take, take_name, take_stamp, unpack
from protocol.wire.messages import Corrections

MAX_CORRECTIONS_BYTES = 16 * 2**10  # a second of a base with all satellites and signals has some 2 kB


def encode_corrections(message: Corrections) -> bytes:
    """What a relay says of its base."""
    return pack(vars(message))


def decode_corrections(data: bytes, base: str) -> Corrections:
    """Undo `encode_corrections`; refused where it is of another base than this one."""
    table = unpack(data, MAX_CORRECTIONS_BYTES)
    if (sender := take_name(table, "base")) != base:
        raise MessageError(Refusal.OUT_OF_RANGE, f"of {sender}, on the key of {base}", field="base")
    problem = one_line(take(table, "problem", str, ""))
    return Corrections(sender, take_stamp(table), take(table, "frames", bytes), problem)
