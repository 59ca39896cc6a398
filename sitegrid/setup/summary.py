"""What was heard, for people: a block for each port, and what is missing for position, slope and resistance. Pure."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime

from agents.drivers.formats import FIX, IMU
from sitegrid.setup.hearing import HeardLine

NO_PORT = "no serial port is there: plug a receiver in, or name an address (tcp://HOST:PORT, udp://:PORT, gpsd, a file)"


def block(heard: HeardLine) -> list[str]:
    """The address, then what comes there and what hinders it."""
    baud = f" at {heard.baud} baud" if heard.baud else ""
    rates = ", ".join(f"{name} {f'{hz:g} Hz' if hz else 'once'}" for name, hz in heard.messages.items())
    said = [f"{heard.kind or 'no driver reads this'}{baud}: {rates}"] if heard.messages else []
    if heard.streams:
        said.append(f"feeds: {', '.join(heard.streams)}")
    if heard.place:
        lat_deg, lon_deg, height_m = heard.place
        accuracy = "accuracy not stated" if heard.accuracy_m is None else f"within {heard.accuracy_m:.2g} m"
        fix = f"{heard.quality}, {heard.satellites} satellites, {accuracy}"
        said.append(f"fix: {fix}, at {lat_deg:.6f} {lon_deg:.6f}, {height_m:.1f} m")
    if heard.utc_ns:
        said.append(f"time: {datetime.fromtimestamp(heard.utc_ns // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC")
    return [heard.address, *(f"  {line}" for line in (*said, heard.problem) if line)]


def missing(every: Sequence[HeardLine]) -> dict[str, str]:
    """What an agent lacks that is fed by these, a sentence for each thing that it cannot know."""
    streams = {stream for heard in every for stream in heard.streams}
    lacks = {} if FIX in streams else {"position": "no receiver: no position, so no sample"}
    if IMU not in streams:
        lacks["slope"] = "no IMU: no slope (of a u-blox with one: switch on ESF-MEAS or ESF-RAW)"
    rest = "slope only" if IMU in streams else "no rolling resistance"
    return lacks | {"resistance": f"no torque: {rest} (no receiver carries it: a driver of your own, or a log)"}
