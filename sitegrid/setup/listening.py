"""Listen to ports, addresses and files, trying usual baud rates until frames arrive."""

from __future__ import annotations

import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

from agents.drivers.can.buses import is_recording
from agents.drivers.formats.framing import GPSD
from agents.drivers.formats.gpsd import GPSD_PORT, GREETING
from agents.drivers.receiver import BAUDS, TRY_S
from agents.drivers.transports import Transport, open_transport, split_address, why_closed
from protocol.errors import ConfigError
from sitegrid.setup.hearing import Ear, HeardLine
from sitegrid.setup.hearing_bus import is_bus, listen_to_bus

MOST_FILE_BYTES = 1 << 22  # of a recording: an hour of a receiver


def address_of(text: str) -> str:
    """An address as in [[driver]]; `gpsd`: on this host. ConfigError if invalid."""
    if is_bus(text) and not is_recording(text):
        return text
    address = f"tcp://127.0.0.1:{GPSD_PORT}" if text == GPSD else text
    if "://" in address:
        try:
            split_address(address)
        except ValueError as error:
            raise ConfigError(text, str(error).removeprefix("address: ")) from None
        return address
    return str(Path(address).absolute())


def listen_to(addresses: Sequence[str], seconds: float, bauds: Sequence[int] = BAUDS) -> list[HeardLine]:
    """Listen to all addresses at once. seconds: from the first frame, or of silence."""
    if not addresses:
        return []
    with ThreadPoolExecutor(len(addresses)) as pool:
        return list(pool.map(lambda address: listen(address, seconds, bauds), addresses))


def listen(address: str, seconds: float, bauds: Sequence[int] = BAUDS) -> HeardLine:
    """Listen to one address; on serial ports at the first baud rate with frames."""
    if is_bus(address):
        return listen_to_bus(address, seconds)
    ear, is_serial = Ear(), "://" not in address
    for baud in bauds if is_serial else bauds[:1]:
        ear = Ear()
        try:
            with closing(open_transport(address, baud)) as transport:
                is_serial = is_serial and transport.is_live
                broke = _hear(transport, ear, seconds)
        except OSError as error:
            return HeardLine(address, problem=why_closed(error))
        if ear.frames or not ear.n_bytes or not is_serial:
            break
    heard = ear.heard(address, baud if is_serial and ear.frames else 0)
    return replace(heard, problem=f"the link broke ({broke})") if broke and not heard.kind else heard


def _hear(transport: Transport, ear: Ear, seconds: float) -> str:
    """Listen until the end; returns why the link broke, or empty."""
    end_s, is_greeted = time.monotonic() + max(seconds, TRY_S), False
    while (left_s := end_s - time.monotonic()) > 0:
        try:
            data = transport.read(min(left_s, 0.1))
        except OSError as error:
            return error.strerror or str(error)
        if data is None or ear.n_bytes > MOST_FILE_BYTES:
            break
        was_heard = bool(ear.frames)
        ear.feed(data, time.monotonic_ns() if transport.is_live else None)
        if ear.frames and not was_heard:
            end_s = time.monotonic() + seconds
        elif not ear.frames and ear.n_bytes:
            end_s = min(end_s, time.monotonic() + TRY_S)
        if transport.is_live and not is_greeted and ear.hears(GPSD):
            transport.write(GREETING)
            is_greeted = True
    return ""
