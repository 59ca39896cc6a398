"""What the signals of a bus feed: streams, each of which makes the values of one kind of reading. Pure."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

from agents.drivers import formats

Values = tuple[float, ...]
Held = Mapping[str, float]  # newest values by signal; those of the frame that just came are among them


class CanStream(NamedTuple):
    """kind: of the readings. begins: a frame with one of these signals makes one. make: KeyError where others lack."""

    kind: str
    begins: tuple[str, ...]
    make: Callable[[Held], Values | None]


def _gone(held: Held, speed_mps: float) -> Values:
    """A speed, which has no sign on the bus: backwards where the newest gear is a reverse one."""
    return math.copysign(speed_mps, -1.0 if held.get("gear", 0.0) < 0 else 1.0), 0.0, 0.0


def _driveline(held: Held) -> Values:
    """What is not stated counts as engaged, locked and without a shift: the ratio of the speeds shows the rest."""
    return held.get("driveline_engaged", 1.0), held.get("converter_locked", 1.0), held.get("gear_shifting", 0.0)


def _velocity(held: Held) -> Values | None:
    is_magnetic = held.get("course_is_magnetic", 0.0)
    return None if is_magnetic else formats.velocity(held["ground_speed"], held["course"], math.nan)


def _losses(held: Held) -> Values:
    return (held["engine_friction"] + held.get("engine_parasitic", 0.0),)


def _mean_rear(held: Held) -> Values:
    return _gone(held, (held["rear_left_speed"] + held["rear_right_speed"]) / 2)


def _place(held: Held) -> Values:
    """A place without height and accuracy: its sensor states that."""
    return held["latitude"], held["longitude"], 0.0, *(math.nan,) * 3


STREAMS = {
    "engine": CanStream("engine", ("engine_torque",), lambda h: (h["engine_torque"], h["engine_speed"])),
    "losses": CanStream("engine_losses", ("engine_friction",), _losses),
    "fuel": CanStream("fuel_rate", ("fuel_rate",), lambda h: (h["fuel_rate"],)),
    "gearbox": CanStream("driveline", ("driveline_engaged", "converter_locked", "gear_shifting"), _driveline),
    "clutch": CanStream("driveline", ("clutch_switch",), lambda h: (1.0 - h["clutch_switch"], 1.0, 0.0)),
    "speed": CanStream("odometry", ("vehicle_speed",), lambda h: _gone(h, h["vehicle_speed"])),
    "rear_speed": CanStream("odometry", ("rear_left_speed",), _mean_rear),
    "brake_switch": CanStream("brake", ("brake_switch",), lambda h: (h["brake_switch"],)),
    "brake_pedal": CanStream("brake", ("brake_pedal",), lambda h: (h["brake_pedal"],)),
    "ebs_switch": CanStream("brake", ("ebs_switch",), lambda h: (h["ebs_switch"],)),
    "retarder": CanStream("retarder", ("retarder_torque",), lambda h: (max(-h["retarder_torque"], 0.0),)),
    "cargo": CanStream("payload", ("cargo_mass",), lambda h: (h["cargo_mass"],)),
    "axles": CanStream("payload", ("axle_load",), lambda h: (h["axle_load"],)),
    "turn_rate": CanStream("odometry", ("turn_rate",), lambda h: (0.0, 0.0, h["turn_rate"])),
    "fix": CanStream("gps", ("latitude",), _place),
    "velocity": CanStream("gps_velocity", ("ground_speed",), _velocity),
}
