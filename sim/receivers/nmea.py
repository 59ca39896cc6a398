"""NMEA 0183 with real receivers' decimals, in u-blox order."""

import math
from functools import reduce
from operator import xor

from agents.drivers.formats.nmea import KNOT_MPS
from sim.receivers.epoch import GEOID_M, SATELLITES, Epoch, quality

NUMBERS = {"autonomous": 1, "differential": 2, "fixed": 4, "float": 5}  # fix quality in GGA
MODES = {"autonomous": "A", "differential": "D", "fixed": "R", "float": "F"}  # mode in RMC and VTG
HDOP = 0.7  # under open sky
SLOW_MPS = 0.1  # below it no course is stated


def sentence(text: str) -> bytes:
    """Add start and checksum."""
    return f"${text}*{reduce(xor, text.encode()):02X}\r\n".encode()


class NmeaWriter:
    """Sentences of one receiver. Fixes by carrier phase have 7 decimals of a minute, others 5."""

    def epoch(self, epoch: Epoch) -> bytes:
        """RMC, VTG, GGA, GST, and THS if there is a baseline."""
        texts = [_rmc(epoch), _vtg(epoch), _gga(epoch), _gst(epoch)]
        if epoch.baseline:
            texts.append(f"GNTHS,{_course(epoch.baseline.heading_rad)},A")
        return b"".join(map(sentence, texts))


def _rmc(epoch: Epoch) -> str:
    knots, course = _motion(epoch)
    status, mode = ("A", MODES[quality(epoch.fix)]) if epoch.fix else ("V", "N")
    return f"GNRMC,{_time(epoch)},{status},{_place(epoch)},{knots},{course},{epoch.time:%d%m%y},,,{mode},V"


def _vtg(epoch: Epoch) -> str:
    knots, course = _motion(epoch)
    kmph = f"{float(knots) * KNOT_MPS * 3.6:.3f}" if knots else ""
    return f"GNVTG,{course},T,,M,{knots},N,{kmph},K,{MODES[quality(epoch.fix)] if epoch.fix else 'N'}"


def _gga(epoch: Epoch) -> str:
    if not epoch.fix:
        return f"GNGGA,{_time(epoch)},,,,,0,00,99.99,,,,,,"
    decimals = 3 if quality(epoch.fix) == "fixed" else 1
    heights = f"{epoch.fix.height_m - GEOID_M:.{decimals}f},M,{GEOID_M:.{decimals}f},M"
    number = NUMBERS[quality(epoch.fix)]
    return f"GNGGA,{_time(epoch)},{_place(epoch)},{number},{SATELLITES},{HDOP},{heights},,"


def _gst(epoch: Epoch) -> str:
    if not epoch.fix:
        return f"GNGST,{_time(epoch)},,,,,,,"
    decimals = 3 if quality(epoch.fix) == "fixed" else 1
    variances = (epoch.fix.var_n_m2, epoch.fix.var_e_m2, epoch.fix.var_u_m2)
    return f"GNGST,{_time(epoch)},,,,,{','.join(f'{variance**0.5:.{decimals}f}' for variance in variances)}"


def _time(epoch: Epoch) -> str:
    return f"{epoch.time:%H%M%S}.{epoch.utc_ns // 10**7 % 100:02}"


def _place(epoch: Epoch) -> str:
    if not epoch.fix:
        return ",,,"
    decimals = 7 if quality(epoch.fix) == "fixed" else 5
    lat, lon = (_minutes(value, width, decimals) for value, width in ((epoch.fix.lat_deg, 2), (epoch.fix.lon_deg, 3)))
    return f"{lat},{'NS'[epoch.fix.lat_deg < 0]},{lon},{'EW'[epoch.fix.lon_deg < 0]}"


def _minutes(degrees: float, width: int, decimals: int) -> str:
    """Degrees and minutes, ddmm.mmmmm; rounded first, so that no minute is 60."""
    units = round(abs(degrees) * 60 * 10**decimals)
    whole, rest = divmod(units, 60 * 10**decimals)
    return f"{whole:0{width}}{rest // 10**decimals:02}.{rest % 10**decimals:0{decimals}}"


def _motion(epoch: Epoch) -> tuple[str, str]:
    """Speed [kn] and course [deg], which slow machines lack."""
    if not (epoch.fix and epoch.motion):
        return "", ""
    east_mps, north_mps = epoch.motion.velocity_e_mps, epoch.motion.velocity_n_mps
    speed_mps = math.hypot(east_mps, north_mps)
    course = _course(math.atan2(east_mps, north_mps)) if speed_mps > SLOW_MPS else ""
    return f"{speed_mps / KNOT_MPS:.3f}", course


def _course(angle_rad: float) -> str:
    """0.00 to 359.99 degrees."""
    return f"{round(math.degrees(angle_rad) % 360, 2) % 360:.2f}"
