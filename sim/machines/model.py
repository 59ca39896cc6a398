"""Kinds of machines: URDF for bodies, joints and mounts, TOML for the rest."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

import numpy as np

from protocol.arrays import Floats
from protocol.config import from_table
from protocol.errors import ConfigError
from protocol.files import load_toml
from protocol.machine.machine_config import BASE, FRONT, Mount
from protocol.rotations import rpy_from_matrix
from sim.machines.drive_train import DriveTrain
from sim.machines.urdf import Mass, Robot, Transform, combined, read_urdf

FOLDER = Path(__file__).parent
PAYLOAD = "payload_link"
WHEELS = tuple(f"{place}_wheel_link" for place in ("front_left", "front_right", "rear_left", "rear_right"))


@dataclass(frozen=True)
class MachineModel:
    """One kind of articulated machine on four wheels, as delivered; `sim/machines/*.toml` explain the values.

    urdf: file beside the TOML file. mass_kg: empty. payload_kg: maximum. load_centre_m: centre of the wheel loads ahead
    of the rear axle, empty. skid_grip: side force over load of sliding wheels, of skid-steered machines, whose joint
    only represents steering; 0: none slide. drive_train: of machines with a CAN bus.
    """

    name: str
    urdf: str
    rear_to_joint_m: float
    front_to_joint_m: float
    track_m: float
    mass_kg: float
    payload_kg: float
    load_centre_m: float
    rotating_mass_factor: float
    max_articulation_rad: float
    steer_radps: float
    steer_gain_per_s: float
    steer_lag_s: float
    steer_nm: float
    max_drive_n: float
    max_brake_n: float
    max_power_w: float
    engine_lag_s: float
    wheel_radius_m: float
    wheel_inertia_kgm2: float
    tyre_stiffness_npm: float
    tyre_damping_nspm: float
    relaxation_m: float
    skid_grip: float = 0.0
    drive_train: DriveTrain | None = None

    def __post_init__(self) -> None:
        if not 0 < self.max_articulation_rad < 1.2:
            raise ValueError("max_articulation_rad: not between 0 and 1.2")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float) and value <= 0 and field.name != "skid_grip":
                raise ValueError(f"{field.name}: {value:g} is not positive")

    @property
    def wheelbase_m(self) -> float:
        """Distance between axles, machine straight."""
        return self.rear_to_joint_m + self.front_to_joint_m

    @property
    def robot(self) -> Robot:
        """Content of the URDF file."""
        return read_urdf(FOLDER / self.urdf)

    @property
    def rolls_with_front(self) -> bool:
        """Whether the rear frame rolls with the front wheels (swinging rear axle) or its own (hitch)."""
        return self.robot.joints[WHEELS[2]].parent != BASE

    def weight(self, payload_kg: float = 0.0) -> Mass:
        """Mass, centre and inertia in `base_link`, machine straight."""
        parts = [(self.robot.place(name, BASE), link.mass) for name, link in self.robot.links.items()]
        load = self.robot.links[PAYLOAD].mass
        share = payload_kg / load.mass_kg
        scaled = Mass(payload_kg, load.centre_m, share * load.inertia_kgm2)
        empty = [(pose, mass) for pose, mass in parts if mass is not load]
        return combined([*empty, (self.robot.place(PAYLOAD, BASE), scaled)])

    @property
    def payload_centre_m(self) -> Floats:
        """Centre of the payload (3,) in `base_link`, machine straight."""
        pose = self.robot.place(PAYLOAD, BASE)
        centre: Floats = pose.xyz_m + pose.rotation @ self.robot.links[PAYLOAD].mass.centre_m
        return centre

    def front_share(self, payload_kg: float = 0.0) -> float:
        """Share of the front axle on level ground."""
        return float(self.weight(payload_kg).centre_m[0]) / self.wheelbase_m

    def centre_height_m(self, payload_kg: float = 0.0) -> float:
        """Height of the centre of mass above ground."""
        return float(self.weight(payload_kg).centre_m[2])

    def gps_mounts(self) -> tuple[Mount, ...]:
        """Antenna mounts in `base_link`."""
        return tuple(_mount(pose) for frame, pose in self._places("gps") if frame == BASE)

    def imu_mounts(self) -> tuple[tuple[str, Mount], ...]:
        """Frame and mount of each IMU. The origin of `front_link` is the joint."""
        return tuple((frame, _mount(pose)) for frame, pose in self._places("imu"))

    def _places(self, kind: str) -> list[tuple[str, Transform]]:
        names = sorted(name for name in self.robot.links if name.startswith(f"{kind}_link_"))
        frames = [self.robot.carrier(name, (BASE, FRONT)) for name in names]
        return [(frame, self.robot.place(name, frame)) for name, frame in zip(names, frames, strict=True)]


@cache
def load_model(name: str) -> MachineModel:
    """Load a kind of machine."""
    path = FOLDER / f"{name}.toml"
    if not path.is_file():
        known = ", ".join(sorted(p.stem for p in FOLDER.glob("*.toml")))
        raise ConfigError("machine model", f"there is no {name!r}; known: {known}")
    return from_table(MachineModel, {"name": name, **load_toml(path)}, str(path))


def _mount(pose: Transform) -> Mount:
    x, y, z = (np.round(pose.xyz_m, 6) + 0.0).tolist()  # + 0.0 removes -0.0
    roll, pitch, yaw = (np.round(np.degrees(rpy_from_matrix(pose.rotation)), 4) + 0.0).tolist()
    return Mount((x, y, z), (roll, pitch, yaw))
