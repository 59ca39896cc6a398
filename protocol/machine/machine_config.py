"""A machine's description: nominal dimensions, and sensors with mounts."""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

import numpy as np

from protocol.arrays import Floats
from protocol.config import from_table, require_between, toml_lines
from protocol.errors import ConfigError
from protocol.machine.powertrain_config import PowertrainConfig
from protocol.machine.readings import KINDS
from protocol.rotations import matrix_from_rpy
from protocol.site.site_config import NAME

BASE, FRONT = "base_link", "front_link"
# Quantities of motion by kind of sensor. A sensor may provide only some, as an IMU without accelerometer.
QUANTITIES = {
    "gps": ("position",),
    "gps_velocity": ("velocity",),
    "imu": ("rate", "force"),
    "attitude": ("tilt", "heading"),
    "odometry": ("speed", "rate"),
    "encoder": ("speed",),
    "steering": ("angle",),
}
# Meaning of values. Differential: successive ones give a rate. Relative: the first stands for the filter's belief,
# later ones count from it (Moore & Stouch, robot_localization).
MODES = ABSOLUTE, DIFFERENTIAL, RELATIVE = ("absolute", "differential", "relative")
WITH_MODE = ("gps", "attitude")
MAX_DELAY_S = 0.4  # below 0.5 s, at which readings are refused as late, to allow for disorder
BEFORE_THE_WHEELS = frozenset({"engine", "motor", "motor_power"})  # kinds that need a powertrain
DRIVES = BEFORE_THE_WHEELS | {"torque"}  # kinds that show the drive force
NOT_NEGATIVE = (
    "wheelbase_m",
    "axle_stiffness_npm",
    "cog_height_m",
    "payload_z_m",
    "drag_area_m2",
    "drive_friction_n",
)
MOST_KG = 500_000.0  # of machine or load; samples state the sum
LIGHT_KG, LONG_M = 500.0, 1.5  # wheelbase for which a smaller mass was written in tonnes
FAR_M = 30.0  # of a mount, beyond any machine
MOST_RADIUS_M = 3.0  # of a wheel; the largest tyre has 2.05 m
MAX_EARLY_S = 10.0  # larger lags of a stamp are clock offsets


@dataclass(frozen=True)
class Mount:
    """A sensor's place in its frame: origin [m], roll, pitch, yaw [deg]."""

    xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if far_m := next((v for v in self.xyz_m if not abs(v) <= FAR_M), 0.0):
            in_m = f"if that is mm, write {far_m / 1000:g}, if cm, {far_m / 100:g}"
            raise ValueError(f"xyz_m: {far_m:g} m is off any machine; {in_m}")

    def frame_from_sensor(self) -> Floats:
        """Rotation (3, 3) from the sensor into its frame, `base_link` or `front_link`."""
        return matrix_from_rpy(*np.radians(self.rpy_deg))


@dataclass(frozen=True)
class SensorConfig:
    """One sensor of a machine.

    name: as in readings. use: false ignores it. measures: used quantities of QUANTITIES; empty: all. std: standard
    deviations by these names, in place of stated or default ones: `position` [m]; `tilt`, `heading` [rad]; `rate`
    [rad/s]; `force` [m/s2]; `speed`, `velocity` [m/s]. mode: one of MODES, for GPS and attitude. delay_s: lag of the
    stamp, negative for a lead. gate_sigma: gate in standard deviations; 0: the filter's. frame: of an articulated
    machine; `front_link` starts at the joint, at hub height. drift_share, drift_time_s: of a receiver: slow share of
    its variance, and correlation time. ticks_per_rev: of an encoder.
    """

    name: str
    kind: str
    mount: Mount = field(default_factory=Mount)
    use: bool = True
    measures: tuple[str, ...] = ()
    std: Mapping[str, float] = field(default_factory=dict, hash=False)
    mode: str = ABSOLUTE
    delay_s: float = 0.0
    gate_sigma: float = 0.0
    frame: str = BASE
    drift_share: float = 0.75
    drift_time_s: float = 45.0
    ticks_per_rev: int = 100

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")
        if self.kind not in KINDS:
            raise ValueError(f"kind: {self.kind!r} is none of {', '.join(KINDS)}")
        self._check_meaning()
        if self.frame not in (BASE, FRONT):
            raise ValueError(f"frame: {self.frame!r} is neither {BASE} nor {FRONT}")
        if not (-MAX_EARLY_S <= self.delay_s <= MAX_DELAY_S and 0 <= self.gate_sigma <= 1000):
            why = "a live agent cannot wait for what comes later (a log folder takes any)"
            limits = f"delay_s must be between -{MAX_EARLY_S:g} and {MAX_DELAY_S:g}: {why}"
            raise ValueError(f"{self.name}: {limits}; gate_sigma between 0 and 1000")
        if not 0 <= self.drift_share <= 1:
            raise ValueError(f"drift_share: {self.drift_share} is not between 0 and 1")
        if self.drift_time_s <= 0 or self.ticks_per_rev <= 0:
            raise ValueError("drift_time_s and ticks_per_rev must be positive")

    def _check_meaning(self) -> None:
        """Refuse names and modes that the kind lacks."""
        known = QUANTITIES.get(self.kind, ())
        for option, names in (("measures", self.measures), ("std", self.std)):
            if unknown := sorted(set(names) - set(known)):
                instead = ", ".join(known) or "nothing"
                raise ValueError(f"{option}: {self.name}: {self.kind} has no {unknown[0]!r}, but {instead}")
        for name, std in self.std.items():
            if not 0 < std < math.inf:
                raise ValueError(f"std: {self.name}: {name} must be positive and finite, not {std}")
        modes = MODES if self.kind in WITH_MODE else (ABSOLUTE,)
        if self.mode not in modes:
            raise ValueError(f"mode: {self.name}: {self.kind} has no {self.mode!r}, but {', '.join(modes)}")

    def true_ns(self, stamp_ns: int) -> int:
        """Time of what a reading of this stamp measured."""
        return stamp_ns - round(self.delay_s * 1e9)

    def provides(self, quantity: str) -> bool:
        """Whether a quantity of QUANTITIES is used."""
        return not self.measures or quantity in self.measures

    def gate(self, usual_sigma: float) -> float:
        """Its gate, else the usual one [standard deviations]."""
        return self.gate_sigma or usual_sigma


@dataclass(frozen=True)
class MachineConfig:
    """A machine's nominal body; `base_link` is its rear frame, on the ground below the rear axle's centre.

    load_centre_m: centre of wheel loads ahead of `base_link`. rotating_mass_factor: mass with wheel inertia over mass.
    Mass is not needed without a drive torque sensor. machine_share: slow variance common to its receivers, None to
    estimate it. skid_steers: None to detect it by turns on the spot.

    The rest is 0 if unknown: wheelbase_m: of the straight machine. axle_stiffness_npm: vertical, both tyres of an axle.
    cog_height_m: of the empty machine. payload_x_m, payload_z_m: load centre ahead of `base_link`, straight, and above
    ground. drag_area_m2: frontal area times drag coefficient. drive_friction_n: at the wheels, between torque sensor
    and wheels, at any speed. powertrain: None with torque at the wheels.
    """

    name: str
    mass_kg: float = 17_500.0
    wheel_radius_m: float = 0.75
    load_centre_m: float = 1.5
    rotating_mass_factor: float = 1.07
    machine_share: float | None = None
    skid_steers: bool | None = None
    wheelbase_m: float = 0.0
    axle_stiffness_npm: float = 0.0
    cog_height_m: float = 0.0
    payload_x_m: float = 0.0
    payload_z_m: float = 0.0
    drag_area_m2: float = 0.0
    drive_friction_n: float = 0.0
    powertrain: PowertrainConfig | None = None
    sensors: tuple[SensorConfig, ...] = ()

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r} is not a name (lower-case letters, digits, - and _)")
        self._check_mass()
        if not 0 < self.wheel_radius_m <= MOST_RADIUS_M:
            problem = f"{self.wheel_radius_m:g} is not above 0 and up to {MOST_RADIUS_M:g}"
            raise ValueError(f"wheel_radius_m: {problem}; if that is mm, write {self.wheel_radius_m / 1000:g}")
        if self.rotating_mass_factor < 1:
            raise ValueError("rotating_mass_factor: below 1")
        if self.machine_share is not None and not 0 <= self.machine_share <= 1:
            raise ValueError(f"machine_share: {self.machine_share} is not between 0 and 1")
        for name in NOT_NEGATIVE:
            if not 0 <= getattr(self, name) < math.inf:  # also false for NaN
                raise ValueError(f"{name}: {getattr(self, name)!r} is not a positive number, nor 0 for not known")
        if not self.wheelbase_m and (blind := [s.name for s in self.sensors if s.kind == "steering" and s.use]):
            raise ValueError(f"wheelbase_m: {blind[0]}: steering is of no use without it, so give it or `use = false`")
        self._check_powertrain()
        names = [s.name for s in self.sensors]
        if twice := sorted({n for n in names if names.count(n) > 1}):
            raise ValueError(f"sensors: two are named {twice[0]!r}")

    def _check_powertrain(self) -> None:
        kinds = {s.kind for s in self.sensors if s.use} & BEFORE_THE_WHEELS
        if kinds and (lacks := self.powertrain.lacks(kinds) if self.powertrain else "of no use without this table"):
            raise ValueError(f"powertrain: {min(kinds)}: {lacks}")

    def _check_mass(self) -> None:
        require_between(self, 1, MOST_KG, "mass_kg")
        if self.mass_kg < LIGHT_KG and self.wheelbase_m >= LONG_M:
            wheelbase = f"a machine with a wheelbase of {self.wheelbase_m:g} m"
            problem = f"{self.mass_kg:g} kg is too little for {wheelbase}; if that is tonnes"
            raise ValueError(f"mass_kg: {problem}, write {self.mass_kg * 1000:g}")

    def sensor(self, name: str) -> SensorConfig | None:
        """The sensor of that name, or None."""
        return next((s for s in self.sensors if s.name == name), None)


def parse_machine(table: Mapping[str, Any], sensors: tuple[SensorConfig, ...], where: str) -> MachineConfig:
    """A machine from its TOML table and sensors."""
    try:
        return replace(from_table(MachineConfig, table, f"{where} [machine]"), sensors=sensors)
    except ValueError as error:
        raise ConfigError(where, str(error)) from None


def sensor_lines(sensor: SensorConfig) -> list[str]:
    """A sensor's keys as TOML."""
    xyz_m, rpy_deg = ([float(v) for v in values] for values in (sensor.mount.xyz_m, sensor.mount.rpy_deg))
    std = ", ".join(f"{name} = {float(value)}" for name, value in sensor.std.items())
    table = f"std = {{ {std} }}" if std else "std = {}"
    return [*plain_lines(sensor), table, f"mount = {{ xyz_m = {xyz_m}, rpy_deg = {rpy_deg} }}"]


def machine_toml(machine: MachineConfig) -> str:
    """A machine and its sensors as agent TOML; drag and friction if known."""
    unknown = {name for name in ("drag_area_m2", "drive_friction_n") if not getattr(machine, name)}
    known = [line for line in plain_lines(machine) if line.partition(" ")[0] not in unknown]
    lines = ["[machine]", *known, *powertrain_lines(machine)]
    for sensor in machine.sensors:
        lines += ["", "[[sensor]]", *sensor_lines(sensor)]
    return "\n".join(lines) + "\n"


def powertrain_lines(machine: MachineConfig) -> list[str]:
    """The powertrain key, if any."""
    values = asdict(machine.powertrain) if machine.powertrain else {}
    return [f"powertrain = {{ {', '.join(toml_lines(values))} }}"] if values else []


def plain_lines(config: Any) -> list[str]:
    """A dataclass's plain values as TOML keys."""
    values = {f.name: getattr(config, f.name) for f in fields(config)}
    plain = {name: value for name, value in values.items() if isinstance(value, bool | int | float | str)}
    names = {name: list(value) for name, value in values.items() if name == "measures"}
    return [f"{name} = {json.dumps(value)}" for name, value in {**plain, **names}.items()]
