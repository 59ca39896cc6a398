"""The parameter groups that are read without a DBC, by their public numbers (SAE J1939-71, NMEA 2000).

Values are in SI units, shares, degrees or litres per hour.
"""

from math import pi

from agents.drivers.can.signals import EXTENDED, Signal

RPM, KMPH = 0.125 * pi / 30, 1 / 256 / 3.6  # a step of the engine's and of a wheel's speed, in rad/s and m/s
NAMES = {
    61440: "ERC1",
    61441: "EBC1",
    61442: "ETC1",
    61444: "EEC1",
    61445: "ETC2",
    65134: "HRW",
    65247: "EEC3",
    65248: "VD",
    65258: "VW",
    65265: "CCVS1",
    65266: "LFE1",
    127251: "rate of turn",
    129025: "position",
    129026: "COG & SOG",
}


def _signal(
    name: str, pgn: int, spn: int, byte: int, bits: int, scale: float = 1.0, offset: float = 0.0, *, bit: int = 1
) -> Signal:
    """A signal whose first byte and first bit count from 1; in NMEA 2000 it has no SPN."""
    return Signal(name, EXTENDED | pgn, 8 * (byte - 1) + bit - 1, bits, scale, offset, spn=spn)


def _torque(name: str, pgn: int, spn: int, byte: int) -> Signal:
    """A share of a reference torque, in steps of 1 %."""
    return _signal(name, pgn, spn, byte, 8, 0.01, -1.25)


def _signed(name: str, pgn: int, byte: int, scale: float) -> Signal:
    return Signal(name, EXTENDED | pgn, 8 * (byte - 1), 32, scale, is_signed=True)


SIGNALS = {
    signal.name: signal
    for signal in (
        _torque("retarder_torque", 61440, 520, 2),
        _signal("ebs_switch", 61441, 1121, 1, 2, bit=7),
        _signal("brake_pedal", 61441, 521, 2, 8, 0.004),
        _signal("driveline_engaged", 61442, 560, 1, 2),
        _signal("converter_locked", 61442, 573, 1, 2, bit=3),
        _signal("gear_shifting", 61442, 574, 1, 2, bit=5),
        _signal("output_speed", 61442, 191, 2, 16, RPM),
        _torque("engine_torque", 61444, 513, 3),
        _signal("engine_speed", 61444, 190, 4, 16, RPM),
        _signal("gear_ratio", 61445, 526, 2, 16, 0.001),
        _signal("gear", 61445, 523, 4, 8, 1.0, -125.0),
        _signal("rear_left_speed", 65134, 1594, 5, 16, KMPH),
        _signal("rear_right_speed", 65134, 1595, 7, 16, KMPH),
        _torque("engine_friction", 65247, 514, 1),
        _torque("engine_parasitic", 65247, 2978, 5),
        _signal("total_distance", 65248, 245, 5, 32, 125.0),
        _signal("axle_location", 65258, 928, 1, 8),
        _signal("axle_load", 65258, 582, 2, 16, 0.5),
        _signal("cargo_mass", 65258, 181, 6, 16, 2.0),
        _signal("vehicle_speed", 65265, 84, 2, 16, KMPH),
        _signal("brake_switch", 65265, 597, 4, 2, bit=5),
        _signal("clutch_switch", 65265, 598, 4, 2, bit=7),
        _signal("fuel_rate", 65266, 183, 1, 16, 0.05),
        _signed("turn_rate", 127251, 2, -3.125e-8),  # positive to starboard on the bus
        _signed("latitude", 129025, 1, 1e-7),
        _signed("longitude", 129025, 5, 1e-7),
        _signal("course_is_magnetic", 129026, 0, 2, 2),
        _signal("course", 129026, 0, 3, 16, 1e-4),
        _signal("ground_speed", 129026, 0, 5, 16, 0.01),
    )
}


def group_name(group: int) -> str:
    """How people call the frames of a group: by J1939's name, else by number."""
    if group < EXTENDED:
        return f"frame 0x{group:03X}"
    pgn = group - EXTENDED
    return f"{NAMES[pgn]} (PGN {pgn})" if pgn in NAMES else f"PGN {pgn}"
