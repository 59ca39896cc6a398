"""Where frames come from: buses and recordings, by python-can. What breaks raises OSError; its owner opens it again."""

import errno
import time
from collections.abc import Iterator
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

from agents.drivers.transports import TOGETHER_S

SOCKETCAN, VIRTUAL, MULTICAST = "socketcan", "virtual", "udp_multicast"  # as python-can calls its interfaces
RECORDINGS = (".candump", ".log", ".asc", ".blf", ".mf4", ".trc")
MOST_FRAMES = 2000  # read at once: a full bus of 500 kbit/s has 80 in that time
BUS_OFF = 0x40  # class of an error frame of SocketCAN
MOST_LATE_S = 1.0  # from a frame's stamp to its reading: more is another clock, or one that was set


class CanFrame(NamedTuple):
    """A data frame. utc_s: by the host's clock as it came in, or by the recording."""

    identifier: int
    is_extended: bool
    data: bytes
    utc_s: float

    @property
    def late_ns(self) -> int:
        """How long ago it came, of a bus."""
        return round(min(max(time.time() - self.utc_s, 0.0), MOST_LATE_S) * 1e9)


class Bus:
    """An open bus. errors: error frames so far. is_off: whether the adapter has left the bus since the last frame."""

    def __init__(self, address: str) -> None:
        """Open it; OSError where that fails."""
        can = _can()
        interface, channel, port = split_bus(address)
        more = {"port": port} if port else {}
        self._can_error = can.CanError
        self.errors, self.is_off = 0, False
        try:
            self._bus = can.Bus(interface=interface, channel=channel, **more)
        except (can.CanError, ValueError) as error:
            raise OSError(errno.EIO, str(error)) from None

    def read(self, timeout_s: float) -> list[CanFrame]:
        """Data frames that have come in, the first within the timeout; OSError where the bus broke."""
        try:
            if (first := self._bus.recv(timeout_s)) is None:
                return []
            time.sleep(TOGETHER_S)
            messages = [first, *islice(iter(lambda: self._bus.recv(0), None), MOST_FRAMES)]
        except self._can_error as error:
            raise OSError(errno.EIO, str(error)) from None
        frames = [frame for message in messages if (frame := _frame(message))]
        errors = [message for message in messages if message.is_error_frame]
        self.errors += len(errors)
        self.is_off = any(e.arbitration_id & BUS_OFF for e in errors) or (self.is_off and not frames)
        return frames

    def close(self) -> None:
        """Let go of it."""
        try:
            self._bus.shutdown()
        except self._can_error as error:
            raise OSError(errno.EIO, str(error)) from None


def read_recording(address: str) -> Iterator[CanFrame]:
    """Data frames of a recording; OSError where it cannot be read (further)."""
    try:
        with _reader(Path(address)) as messages:
            yield from (frame for message in messages if (frame := _frame(message)))
    except Exception as error:  # readers of python-can raise anything on a file that is broken
        why = error.strerror if isinstance(error, OSError) else str(error)
        raise OSError(errno.EIO, why or type(error).__name__) from None


def is_recording(address: str) -> bool:
    """Whether an address is that of a file."""
    return address.endswith(RECORDINGS)


def split_bus(address: str) -> tuple[str, str, int]:
    """Interface, channel and port of `can0`, `virtual://NAME` or `udp_multicast://GROUP[:PORT]`; ValueError if none."""
    interface, separator, channel = address.rpartition("://")
    host, _, port = channel.rpartition(":")
    if interface == MULTICAST and host and port.isdigit() and 0 < int(port) < 1 << 16:
        return interface, host.strip("[]"), int(port)
    if not channel or (separator and interface not in (SOCKETCAN, VIRTUAL, MULTICAST)):
        recordings = ", ".join(f"*{suffix}" for suffix in RECORDINGS)
        kinds = "a bus (can0), virtual://NAME, udp_multicast://GROUP[:PORT]"
        raise ValueError(f"address: {address!r} is neither {kinds} nor a recording ({recordings})")
    return interface or SOCKETCAN, channel, 0


def why_shut(address: str, error: OSError) -> str:
    """Why a bus cannot be opened and what to do, in one sentence."""
    if error.errno == errno.ENODEV or "No such device" in str(error):
        return f"no such bus: plug the adapter in, then `ip link set {address} up type can bitrate 250000`"
    if error.errno == errno.EAFNOSUPPORT:
        return "this host's kernel has no SocketCAN: load its modules (`modprobe can_raw`), or use another host"
    return error.strerror or str(error)


def buses(devices: Path = Path("/sys/class/net")) -> list[str]:
    """CAN buses of this host."""
    types = ((path.parent.name, path) for path in sorted(devices.glob("*/type")))
    return [name for name, path in types if path.read_text("ascii").strip() == "280"]  # ARPHRD_CAN


def _can() -> Any:
    try:
        import can  # of the extra `can`
    except ImportError:
        raise OSError(errno.ENOPKG, "python-can is not installed: pip install '.[can]'") from None
    return can


def _reader(path: Path) -> Any:
    can = _can()
    if path.suffix == ".mf4" and not find_spec("asammdf"):
        raise OSError(errno.ENOPKG, "MF4 needs asammdf: pip install asammdf")
    if path.suffix == ".candump":
        return can.CanutilsLogReader(path)
    return can.LogReader(path, **({"relative_timestamp": False} if path.suffix == ".asc" else {}))


def _frame(message: Any) -> CanFrame | None:
    if message.is_error_frame or message.is_remote_frame:
        return None
    return CanFrame(message.arbitration_id, message.is_extended_id, bytes(message.data), message.timestamp)
