"""Units of logs and their factors to field suffixes; time spans, standard gravity."""

import math
import re
from datetime import UTC, datetime

GRAVITY_MPS2 = 9.80665  # standard gravity (ISO 80000-3)
DIESEL_J_PER_L = 35.8e6  # lower heating value
JOULE_PER_KWH = 3.6e6
MINUTE_NS = 60 * 10**9
HOUR_NS = 60 * MINUTE_NS
DAY_NS = 24 * HOUR_NS

# unit -> {field suffix: factor from the unit}
_UNITS: dict[str, dict[str, float]] = {
    "m": {"_m": 1.0},
    "mm": {"_m": 1e-3},
    "m2": {"_m2": 1.0},
    "deg": {"_deg": 1.0, "_rad": math.pi / 180},
    "rad": {"_rad": 1.0, "_deg": 180 / math.pi},
    "rad2": {"_rad2": 1.0},
    "deg2": {"_rad2": (math.pi / 180) ** 2},
    "rad/s": {"_radps": 1.0},
    "deg/s": {"_radps": math.pi / 180},
    "m/s": {"_mps": 1.0},
    "mm/s": {"_mps": 1e-3},
    "km/h": {"_mps": 1 / 3.6},
    "kn": {"_mps": 1852 / 3600},
    "m2/s2": {"_m2ps2": 1.0},
    "m/s2": {"_mps2": 1.0},
    "g": {"_mps2": GRAVITY_MPS2},
    "Nm": {"_nm": 1.0},
    "kNm": {"_nm": 1e3},
    "ticks": {"_ticks": 1.0},
    "kg": {"_kg": 1.0},
    "t": {"_kg": 1e3},
    "s": {"_s": 1.0},
}
_NS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}
ISO, DDMM = "iso", "ddmm"  # texts: a time with zone; NMEA degrees and minutes
_FRACTION = re.compile(r"[.,](\d+)")
_DDMM = re.compile(r"([-+]?)(\d{0,3})([0-5]\d(?:\.\d*)?) ?([NSEW]?)")


def factor(unit: str, field: str) -> float:
    """Factor from `unit` to that of `field`; ValueError if unknown or unfit."""
    if unit not in _UNITS:
        raise ValueError(f"unit `{unit}` is not known; known: {', '.join(_UNITS)}")
    suffix = "_" + field.rsplit("_", 1)[-1]
    if suffix not in _UNITS[unit]:
        raise ValueError(f"unit `{unit}` does not fit `{field}`")
    return _UNITS[unit][suffix]


def stamp_scale(unit: str) -> int:
    """Nanoseconds per `unit`; ValueError."""
    if unit not in _NS:
        raise ValueError(f"unit `{unit}` is no unit of time; known: {', '.join((*_NS, ISO))}")
    return _NS[unit]


def stamp_ns(text: str, scale: int) -> int:
    """Parse a time; integers exactly, as doubles hold UTC nanoseconds only to 256 ns."""
    try:
        return int(text) * scale
    except ValueError:
        return round(float(text) * scale)


def iso_ns(text: str) -> int:
    """UTC nanoseconds of an ISO 8601 time with zone, to 9 decimals; ValueError."""
    fraction = _FRACTION.search(text)
    try:
        time = datetime.fromisoformat(_FRACTION.sub("", text.strip(), 1))
    except ValueError:
        raise ValueError("is no time in ISO 8601") from None
    if time.tzinfo is None:
        raise ValueError("names no zone, as Z or +02:00")
    seconds = round(time.astimezone(UTC).timestamp())
    return seconds * 10**9 + int(fraction[1][:9].ljust(9, "0") if fraction else 0)


def ddmm_deg(text: str, side: str = "", sides: str = "NSEW") -> float:
    """Degrees of ddmm.mmmm; ValueError. side: one of `sides`, unless a last letter or a sign says it."""
    if not (match := _DDMM.fullmatch(text.strip())) or (match[4] and (side or match[1])):
        raise ValueError("is not ddmm.mmmm, with minutes below 60")
    if (letter := side.strip() or match[4]) not in ("", *sides):
        raise ValueError(f"is on side {letter!r}, not {' or '.join(sides)}")
    degrees = int(match[2] or 0) + float(match[3]) / 60
    return -degrees if letter in ("S", "W") or match[1] == "-" else degrees
