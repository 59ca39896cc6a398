"""Columns of a log to reading values: alternatives, and defaults.

Logs may have places in metres, speed and course, or standard deviations; readings have one form of each.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from protocol.errors import ConfigError, MessageError, Refusal
from protocol.machine.csv_file import Column, Row, number_reader
from protocol.machine.machine_config import SensorConfig
from protocol.machine.readings import columns
from protocol.site.site_config import Projection, SiteConfig

Values = dict[str, float]
# Alternatives to two columns: place in `map` [m]; speed and course, clockwise from north.
INSTEAD = {
    "gps": (("x_m", "y_m"), ("lat_deg", "lon_deg")),
    "gps_velocity": (("speed_mps", "course_deg"), ("velocity_e_mps", "velocity_n_mps")),
}
# Quantity of each variance, as in `std` and `measures`.
VARIANCES = {
    "gps": {"var_e_m2": "position", "var_n_m2": "position"},
    "gps_velocity": {"var_e_m2ps2": "velocity", "var_n_m2ps2": "velocity"},
    "attitude": {"var_roll_rad2": "tilt", "var_pitch_rad2": "tilt", "var_yaw_rad2": "heading"},
}
_MEASURED = {
    "imu": {"gyro": "rate", "force": "force"},
    "odometry": {"speed": "speed", "rate": "rate"},
}
_UNUSED = {"gps": {"var_u_m2": 100.0}, "odometry": {"speed_y_mps": 0.0}}  # by nobody yet
_STD_UNITS = {"_m2": "_m", "_m2ps2": "_mps", "_rad2": "_rad"}
MAX_FAR_M = 100_000.0  # greatest site extent, against metres from elsewhere


def std_name(variance: str) -> str:
    """Standard deviation column of a variance: `std_e_m` of `var_e_m2`."""
    _, axis, unit = variance.split("_")
    return f"std_{axis}{_STD_UNITS['_' + unit]}"


@dataclass(frozen=True)
class ReadingColumns:
    """File rows to a sensor's reading values. described: of the manifest; absent: defaults of others."""

    sensor: SensorConfig
    described: Mapping[str, Column]
    absent: Mapping[str, float]

    def reader(self, site: SiteConfig) -> Callable[[Row], tuple[float, ...]]:
        """Function from a row to values, in the kind's column order.

        ValueError for text that is no number, MessageError for an impossible value.
        """
        picks = [(name, number_reader(column, name)) for name, column in self.described.items()]
        names, steps, overruled = columns(self.sensor.kind), self._steps(site), self._variances()

        def values(row: Row) -> tuple[float, ...]:
            made = {**self.absent, **{name: pick(row) for name, pick in picks}}
            for step in steps:
                step(made)
            made |= {name: value for name, value in overruled.items() if not made[name] > 0}  # also NaN, unknown too
            return tuple(made[name] for name in names)

        return values

    def _variances(self) -> Values:
        """Variances by the sensor's `std`, for rows with 0 or less, which many receivers write if unknown.

        Unused variances refuse no row.
        """
        unused = {name: value for name, value in _UNUSED.get(self.sensor.kind, {}).items() if name.startswith("var_")}
        variances = VARIANCES.get(self.sensor.kind, {}).items()
        return unused | {
            name: self.sensor.std[quantity] ** 2 for name, quantity in variances if quantity in self.sensor.std
        }

    def _steps(self, site: SiteConfig) -> list[Callable[[Values], None]]:
        variances = [name for name in columns(self.sensor.kind) if name.startswith("var_")]
        squared = {std: name for name in variances if (std := std_name(name)) in self.described}
        steps: list[Callable[[Values], None]] = [_squares(squared)] if squared else []
        if "x_m" in self.described:
            steps.append(_places(Projection(site)))
        if "course_deg" in self.described:
            steps.append(_directions)
        return steps


def reading_columns(
    sensor: SensorConfig, described: Mapping[str, Column], site: SiteConfig, where: str
) -> ReadingColumns:
    """A sensor's columns; ConfigError for unknown, missing or duplicate ones."""
    kind, names = sensor.kind, columns(sensor.kind)
    new, old = INSTEAD.get(kind, ((), ()))
    forms = {name: (std_name(name),) if name.startswith("var_") else new if name in old else () for name in names}
    known = dict.fromkeys(("stamp", *names, *(form for some in forms.values() for form in some)))
    if unknown := sorted(set(described) - set(known)):
        raise ConfigError(where, f"unknown column `{unknown[0]}`; a {kind} has {', '.join(known)}")
    absent = {}
    for name in names:
        others = [form for form in forms[name] if form in described]
        if name in described and others:
            raise ConfigError(where, f"columns `{name}` and `{others[0]}` are described; one of them is enough")
        if others and (missing := [form for form in forms[name] if form not in described]):
            raise ConfigError(where, f"column `{missing[0]}` is not described; `{others[0]}` needs it")
        if name not in described and not others:
            absent[name] = _value_of_absent(sensor, name, forms[name], site, where)
    return ReadingColumns(sensor, described, absent)


def _value_of_absent(sensor: SensorConfig, name: str, forms: tuple[str, ...], site: SiteConfig, where: str) -> float:
    """Default of a column: unmeasured, or stated elsewhere."""
    if name == "height_m":
        return site.origin_height_m
    if name in (unused := _UNUSED.get(sensor.kind, {})):
        return unused[name]
    if quantity := VARIANCES.get(sensor.kind, {}).get(name):
        if quantity in sensor.std:
            return sensor.std[quantity] ** 2
        if not sensor.provides(quantity):
            return 1.0
        std = f"`std = {{ {quantity} = ... }}` of the sensor"
        raise ConfigError(where, f"column `{name}` is not described, nor `{forms[0]}`, nor {std}")
    measured = _MEASURED.get(sensor.kind, {}).get(name.split("_")[0])
    if measured and not sensor.provides(measured):
        return 0.0
    or_form = f", nor `{forms[0]}`" if forms else ""
    raise ConfigError(where, f"column `{name}` is not described{or_form}")


def _squares(variances: Mapping[str, str]) -> Callable[[Values], None]:
    def square(values: Values) -> None:
        for std, variance in variances.items():
            if (value := values.pop(std)) < 0:
                raise MessageError(Refusal.OUT_OF_RANGE, f"{value!r} is negative", field=std)
            values[variance] = value**2

    return square


def _places(projection: Projection) -> Callable[[Values], None]:
    def place(values: Values) -> None:
        for name in ("x_m", "y_m"):
            value = values[name]
            if not abs(value) <= MAX_FAR_M:  # also for NaN
                reason = Refusal.OUT_OF_RANGE if math.isfinite(value) else Refusal.NOT_FINITE
                problem = f"{value!r} is not within {MAX_FAR_M / 1000:g} km of the site's origin"
                raise MessageError(reason, problem, field=name)
        values["lat_deg"], values["lon_deg"], _ = projection.to_geodetic(values.pop("x_m"), values.pop("y_m"))

    return place


def _directions(values: Values) -> None:
    speed, course = values.pop("speed_mps"), math.radians(values.pop("course_deg"))
    if not math.isfinite(course):
        raise MessageError(Refusal.NOT_FINITE, f"{course!r} is no direction", field="course_deg")
    values["velocity_e_mps"], values["velocity_n_mps"] = speed * math.sin(course), speed * math.cos(course)
