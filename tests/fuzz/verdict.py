"""Law of decoders: a correct value, or a documented one-line error that names the place.

No other error, no warning, at most CPU_S of CPU time, memory bounded by the input's size.
"""

from __future__ import annotations

import signal
import traceback
import tracemalloc
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

from hypothesis.strategies import SearchStrategy

from protocol.errors import MessageError, QueryError, Refusal, one_line

CPU_S = 10.0  # stops hangs: no such input takes a tenth of a second
MEMORY_BYTES = 24 * 2**20  # allowed for any input, and
MEMORY_PER_BYTE = 100  # per byte of it: 1 B of MessagePack can be an object of 32 B in a list of 8 B
LINE_CHARACTERS = 500
WHOLE = (Refusal.NOT_MSGPACK, Refusal.TOO_LARGE)  # refer to a whole message


@dataclass(frozen=True)
class Decoder:
    """One decoder under test.

    decode: AssertionError for an incorrect value. errors: permitted ones. place: named by these errors' messages,
    besides a MessageError's field. inputs: from seeds.
    """

    name: str
    seeds: tuple[bytes, ...]
    decode: Callable[[bytes], object]
    errors: tuple[type[Exception], ...]
    inputs: Callable[[tuple[bytes, ...]], SearchStrategy[bytes]]
    place: str = ""


class FaultError(Exception):
    """A decoder broke the law. signature: identifies the fault."""

    def __init__(self, signature: str, problem: str) -> None:
        super().__init__(f"{signature}: {problem[:300]}")
        self.signature = signature


class _OutOfTime(BaseException):
    """Raised by the timer; not caught by `except Exception`."""


def judge(decoder: Decoder, data: bytes) -> bool:
    """Whether the input is accepted; FaultError unless accepted or properly refused."""
    try:
        with _bounded(len(data)):
            decoder.decode(data)
    except decoder.errors as error:
        _check_message(decoder, error)
        return False
    except _OutOfTime:
        raise FaultError("hang", f"more than {CPU_S} s of processor time") from None
    except FaultError:
        raise
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        raise FaultError(f"{type(error).__name__} in {frame.name}", repr(error)) from error
    return True


@contextmanager
def watched() -> Iterator[None]:
    """Measure memory and CPU time during the block; warnings are faults."""

    def on_alarm(number: int, frame: FrameType | None) -> None:
        raise _OutOfTime

    before = signal.signal(signal.SIGVTALRM, on_alarm)
    tracemalloc.start()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        tracemalloc.stop()
        signal.signal(signal.SIGVTALRM, before)


@contextmanager
def _bounded(n: int) -> Iterator[None]:
    tracemalloc.reset_peak()
    begin, _ = tracemalloc.get_traced_memory()
    signal.setitimer(signal.ITIMER_VIRTUAL, CPU_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        used = tracemalloc.get_traced_memory()[1] - begin
        if used > MEMORY_BYTES + MEMORY_PER_BYTE * n:
            raise FaultError("memory", f"{used / 2**20:.0f} MiB for an input of {n} bytes")


def _check_message(decoder: Decoder, error: Exception) -> None:
    text = str(error)
    if not text.isprintable() or not text.strip() or len(text) > LINE_CHARACTERS:
        raise FaultError(f"no plain line in {type(error).__name__}", f"{len(text)} characters: {text[:200]!r}")
    if decoder.place and decoder.place not in text:
        raise FaultError(f"no place in {type(error).__name__}", f"{decoder.place!r} is not in {text!r}")
    if isinstance(error, MessageError) and error.reason not in WHOLE:
        is_named = error.field and text.startswith(one_line(str(error.field))[:20])
        if not is_named:
            raise FaultError(f"no field in {type(error).__name__}", f"field {error.field!r} of {text!r}")
    if isinstance(error, QueryError) and "`" not in text and "bounds" not in text and "region" not in text:
        raise FaultError("no parameter in QueryError", text)
