"""URDF files: links, joints, poses, and their reduction to the bodies that a physics engine moves.

Own code: PyBullet's loader misplaces the centres of mass of merged links; yourdfpy merges none and needs a mesh
library.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from protocol.arrays import Floats
from protocol.errors import ConfigError
from protocol.rotations import matrix_from_rpy, rpy_from_matrix


@dataclass(frozen=True)
class Transform:
    """Pose in the parent frame: origin (3,) [m], rotation (3, 3). `a @ b`: b, given in a, in the parent of a."""

    xyz_m: Floats
    rotation: Floats

    def __matmul__(self, inner: Transform) -> Transform:
        return Transform(self.xyz_m + self.rotation @ inner.xyz_m, self.rotation @ inner.rotation)


@dataclass(frozen=True)
class Mass:
    """Rigid mass: centre (3,) [m], inertia (3, 3) [kg m2] about the centre, both along the frame's axes."""

    mass_kg: float
    centre_m: Floats
    inertia_kgm2: Floats


@dataclass(frozen=True)
class Box:
    """Collision box: pose in the link, size (3,) [m]."""

    pose: Transform
    size_m: Floats


@dataclass(frozen=True)
class Link:
    """One link; massless if it only marks a place."""

    name: str
    mass: Mass
    boxes: tuple[Box, ...]


@dataclass(frozen=True)
class Joint:
    """One joint: the child's pose at angle 0; axis and limits [rad] if it turns."""

    name: str
    kind: str
    parent: str
    child: str
    pose: Transform
    axis: Floats
    lower_rad: float
    upper_rad: float


@dataclass(frozen=True)
class Robot:
    """Links by name, joints by child."""

    name: str
    links: dict[str, Link]
    joints: dict[str, Joint]

    def place(self, link: str, frame: str) -> Transform:
        """Pose of a link in an ancestor frame, all joints at angle 0."""
        pose = Transform(np.zeros(3), np.eye(3))
        while link != frame:
            joint = self.joints[link]
            pose, link = joint.pose @ pose, joint.parent
        return pose

    def carrier(self, link: str, bodies: Iterable[str]) -> str:
        """First of `bodies` at or above the link."""
        while link not in bodies:
            link = self.joints[link].parent
        return link


@cache
def read_urdf(path: Path) -> Robot:
    """Parse a URDF file; ConfigError on failure."""
    try:
        root = ET.parse(path).getroot()  # noqa: S314 (the package's own files)
        links = {name: _link(name, e) for e in root.findall("link") if (name := e.attrib["name"])}
        joints = {joint.child: joint for joint in map(_joint, root.findall("joint"))}
    except (OSError, ET.ParseError, KeyError, ValueError) as error:
        raise ConfigError(path, f"is no URDF file that we can read: {error!r}") from None
    return Robot(root.get("name", path.stem), links, joints)


def combined(masses: Iterable[tuple[Transform, Mass]]) -> Mass:
    """Combine masses, each in the frame of its pose (parallel axis theorem)."""
    moved = [(mass.mass_kg, pose @ Transform(mass.centre_m, np.eye(3)), mass.inertia_kgm2) for pose, mass in masses]
    total = sum(kg for kg, _, _ in moved)
    centre = sum((kg * at.xyz_m for kg, at, _ in moved), np.zeros(3)) / max(total, 1e-9)
    inertia = np.zeros((3, 3))
    for kg, at, own in moved:
        arm = at.xyz_m - centre
        inertia += at.rotation @ own @ at.rotation.T + kg * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Mass(total, centre, inertia)


def rigid_urdf(robot: Robot, bodies: tuple[str, ...], mass_factor: float) -> str:
    """Reduce a robot to these links; all others merge into their carriers, so wheels do not turn.

    Replaces PyBullet's URDF_MERGE_FIXED_LINKS. mass_factor: scales all masses.
    """
    root = ET.Element("robot", name=robot.name)
    for body in bodies:
        parts = [link for name, link in robot.links.items() if robot.carrier(name, bodies) == body]
        poses = [robot.place(part.name, body) for part in parts]
        mass = combined((pose, part.mass) for pose, part in zip(poses, parts, strict=True))
        link = ET.SubElement(root, "link", name=body)
        _write_inertial(link, mass, mass_factor)
        for pose, part in zip(poses, parts, strict=True):
            for box in part.boxes:
                collision = ET.SubElement(link, "collision")
                _write_origin(collision, pose @ box.pose)
                ET.SubElement(ET.SubElement(collision, "geometry"), "box", size=_text(box.size_m))
        if body in robot.joints:
            _write_joint(root, robot, robot.joints[body], bodies)
    return ET.tostring(root, encoding="unicode")


def _numbers(text: str) -> Floats:
    return np.array([float(word) for word in text.split()])


def _text(numbers: Floats) -> str:
    return " ".join(repr(float(n)) for n in numbers)


def _pose(element: ET.Element) -> Transform:
    origin = element.find("origin")
    attributes = {} if origin is None else origin.attrib
    rotation = matrix_from_rpy(*_numbers(attributes.get("rpy", "0 0 0")))
    return Transform(_numbers(attributes.get("xyz", "0 0 0")), rotation)


def _link(name: str, element: ET.Element) -> Link:
    boxes = tuple(
        Box(_pose(collision), _numbers(box.attrib["size"]))
        for collision in element.findall("collision")
        for box in collision.findall("geometry/box")
    )
    return Link(name, _mass(element.find("inertial")), boxes)


def _mass(inertial: ET.Element | None) -> Mass:
    if inertial is None:
        return Mass(0.0, np.zeros(3), np.zeros((3, 3)))
    mass, inertia = inertial.find("mass"), inertial.find("inertia")
    if mass is None or inertia is None:
        raise ValueError("an <inertial> without <mass> or <inertia>")
    xx, yy, zz, xy, xz, yz = (float(inertia.attrib[f"i{axes}"]) for axes in ("xx", "yy", "zz", "xy", "xz", "yz"))
    pose, own = _pose(inertial), np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    return Mass(float(mass.attrib["value"]), pose.xyz_m, pose.rotation @ own @ pose.rotation.T)


def _joint(element: ET.Element) -> Joint:
    ends = {end: e.attrib["link"] for end in ("parent", "child") if (e := element.find(end)) is not None}
    axis, limit = element.find("axis"), element.find("limit")
    limits = {} if limit is None else limit.attrib
    return Joint(
        name=element.attrib["name"],
        kind=element.attrib["type"],
        parent=ends["parent"],
        child=ends["child"],
        pose=_pose(element),
        axis=_numbers("1 0 0" if axis is None else axis.attrib["xyz"]),
        lower_rad=float(limits.get("lower", 0)),
        upper_rad=float(limits.get("upper", 0)),
    )


def _write_origin(parent: ET.Element, pose: Transform) -> None:
    ET.SubElement(parent, "origin", xyz=_text(pose.xyz_m), rpy=_text(rpy_from_matrix(pose.rotation)))


def _write_inertial(link: ET.Element, mass: Mass, factor: float) -> None:
    inertial = ET.SubElement(link, "inertial")
    _write_origin(inertial, Transform(mass.centre_m, np.eye(3)))
    ET.SubElement(inertial, "mass", value=repr(float(mass.mass_kg * factor)))
    i = mass.inertia_kgm2 * factor
    values = {"ixx": i[0, 0], "iyy": i[1, 1], "izz": i[2, 2], "ixy": i[0, 1], "ixz": i[0, 2], "iyz": i[1, 2]}
    ET.SubElement(inertial, "inertia", {key: repr(float(value)) for key, value in values.items()})


def _write_joint(root: ET.Element, robot: Robot, joint: Joint, bodies: tuple[str, ...]) -> None:
    parent = robot.carrier(joint.parent, bodies)
    element = ET.SubElement(root, "joint", name=joint.name, type=joint.kind)
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=joint.child)
    _write_origin(element, robot.place(joint.parent, parent) @ joint.pose)
    ET.SubElement(element, "axis", xyz=_text(joint.axis))
    limits = {"lower": repr(joint.lower_rad), "upper": repr(joint.upper_rad), "effort": "1e9", "velocity": "100"}
    ET.SubElement(element, "limit", limits)
