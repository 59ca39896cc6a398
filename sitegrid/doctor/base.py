"""Base stations as this host hears them."""

from __future__ import annotations

import math
import time

import zenoh

from protocol.errors import MessageError
from protocol.machine.readings import Correction
from protocol.wire import keys
from protocol.wire.correction_codec import decode_correction
from sitegrid.doctor import Finding, Level, skipped

CORRECTION_S = 1.5  # they come five times a second
SURE, OFF_M = 3.0, 1.0  # a lasting error of so many standard deviations, and of so much, is a wrong place


def receive_correction(session: zenoh.Session, site: str, frame: str) -> Correction | MessageError | None:
    """A correction of whichever base station speaks first, or why it is refused; None if none comes in."""
    key = keys.corrections_all(site)
    with session.declare_subscriber(key, zenoh.handlers.RingChannel(1)) as subscriber:
        end_s = time.monotonic() + CORRECTION_S
        while not (sample := subscriber.try_recv()):
            if time.monotonic() >= end_s:
                return None
            time.sleep(0.05)
    try:
        return decode_correction(sample.payload.to_bytes(), frame).correction
    except MessageError as error:
        return error


def check_base(correction: Correction | MessageError | None) -> Finding:
    """Whether what a base station says makes sense; many sites have none."""
    if correction is None:
        return skipped("base", "no base station speaks")
    if isinstance(correction, MessageError):
        return Finding(Level.FAIL, "base", f"a correction is refused: {correction}", "update the older side")
    off_m, std_m = math.hypot(correction.offset_e_m, correction.offset_n_m), math.sqrt(correction.offset_m2)
    lasts = f"its fixes lie {off_m:.1f} m from its place on average, +- {2 * std_m:.1f} m"
    if off_m > max(SURE * std_m, OFF_M):
        where = f"{correction.offset_e_m:+.1f} m east, {correction.offset_n_m:+.1f} m north"
        return Finding(Level.WARN, "base", f"{correction.sensor}: {lasts} ({where})", "check `place` in its config")
    return Finding(Level.PASS, "base", f"{correction.sensor} publishes corrections; {lasts}")
