"""Rendered views of a site and its machines, by PyBullet's software renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from protocol.arrays import AnyArray, Floats, Ints
from protocol.site.ground_classes import ZONES
from sim.machines.model import FOLDER, MachineModel
from sim.state import FleetState
from sim.terrain.terrain import Terrain
from sim.worlds.bullet_client import pybullet

MESH_M, MAX_NODES = 1.0, 60_000  # node spacing of the drawn ground; coarser on large sites
TEXEL_M, MAX_TEXELS = 0.1, 6_000_000  # texel size, likewise
MARGIN = 0.04  # share of an overview's frame left around the site
SKY_RGB = (196, 214, 232)
GRAIN = 0.06  # brightness noise, so that the ground's shape and motion are visible
SUN = (-0.8, 0.45, 1.0)  # from the north-west, as on maps
RELIEF = 1.1  # brightness per unit of gradient
SHADE = 0.5  # brightness under a machine
SKIRT_M = 5.0  # depth of the block that the site is cut out of
SKIRT_RGBA = (0.42, 0.36, 0.30, 1.0)


@dataclass(frozen=True)
class Camera:
    """target [m], distance [m], yaw from north clockwise [deg], pitch above the horizon [deg]."""

    target_m: tuple[float, float, float]
    distance_m: float
    yaw_deg: float = 25.0
    pitch_deg: float = 35.0
    view_deg: float = 45.0
    width: int = 1280
    height: int = 720


def overview(terrain: Terrain, width: int = 1280, height: int = 720) -> Camera:
    """Closest camera that sees the whole site, in a picture of this size [px]."""
    camera = Camera((0.0, 0.0, 0.0), 1.0, yaw_deg=16.0, pitch_deg=43.0, width=width, height=height)
    depth_m, width_m = (terrain.cell_m * (n - 1) for n in terrain.heights_m.shape)
    low, high = float(terrain.heights_m.min()) - SKIRT_M, float(terrain.heights_m.max())
    corners = np.array([(x, y, z) for x in (0, width_m) for y in (0, depth_m) for z in (low, high)])
    right, up, forward = _axes(camera)
    upwards = (1 - MARGIN) * np.tan(np.radians(camera.view_deg / 2))
    distance, target = 0.0, corners.mean(axis=0)
    # A corner p is inside if |axis . (p - target)| <= slope * (distance + forward . (p - target)).
    for axis, slope in ((right, upwards * width / height), (up, upwards)):
        across, away = (corners - target) @ axis, slope * ((corners - target) @ forward)
        most, least = float((across - away).max()), float((across + away).min())
        distance = max(distance, (most - least) / 2 / slope)
        target = target + (most + least) / 2 * axis
    x, y, z = target.tolist()
    return replace(camera, target_m=(x, y, z), distance_m=distance)


def _axes(camera: Camera) -> Floats:
    """Right, up, forward of a camera in `map`, one per row."""
    yaw, pitch = np.radians([camera.yaw_deg, camera.pitch_deg])
    right = [np.cos(yaw), np.sin(yaw), 0.0]
    forward = [-np.sin(yaw) * np.cos(pitch), np.cos(yaw) * np.cos(pitch), -np.sin(pitch)]
    return np.array([right, np.cross(right, forward), forward])


def closeup(state: FleetState, machine: int, model: MachineModel, width: int = 1280, height: int = 720) -> Camera:
    """Camera beside and ahead of one machine, in a picture of this size [px]."""
    x, y, z, yaw = (float(v[machine]) for v in (state.x_m, state.y_m, state.z_m, state.yaw_rad))
    ahead_m = 0.6 * model.wheelbase_m  # about the machine's middle
    target = (x + ahead_m * np.cos(yaw), y + ahead_m * np.sin(yaw), z + 1.0)
    away_m = model.wheelbase_m * max(2.7, 3.6 * height / width)
    turned = float(np.degrees(yaw)) + 35.0
    return Camera(target, away_m, yaw_deg=turned, pitch_deg=22.0, width=width, height=height)


def render(
    terrain: Terrain, models: Sequence[MachineModel], state: FleetState, cameras: Sequence[Camera]
) -> list[AnyArray]:
    """Draw machines on their ground; one picture (height, width, 3) uint8 BGR per camera."""
    client = pybullet.connect(pybullet.DIRECT)
    try:
        with TemporaryDirectory() as folder:
            _ground(client, terrain, _shades(models, state), Path(folder))
            for machine, model in enumerate(models):
                _machine(client, model, state, machine)
            return [_photograph(client, camera) for camera in cameras]
    finally:
        pybullet.disconnect(client)


def _machine(client: int, model: MachineModel, state: FleetState, i: int) -> None:
    turn = [float(angle[i]) for angle in (state.roll_rad, state.pitch_rad, state.yaw_rad)]
    place = [float(v[i]) for v in (state.x_m, state.y_m, state.z_m)]
    body = pybullet.loadURDF(
        str(FOLDER / model.urdf), place, pybullet.getQuaternionFromEuler(turn), physicsClientId=client
    )
    names = [pybullet.getJointInfo(body, j, client)[1].decode() for j in range(pybullet.getNumJoints(body, client))]
    angle = float(state.articulation_rad[i])
    pybullet.resetJointState(body, names.index("articulation"), angle, physicsClientId=client)


def _shades(models: Sequence[MachineModel], state: FleetState) -> list[Floats]:
    """Outlines (4, 2) of the frames from above."""
    outlines = []
    for i, model in enumerate(models):
        yaw, bend = float(state.yaw_rad[i]), float(state.articulation_rad[i])
        rear, half = np.array([state.x_m[i], state.y_m[i]]), 0.5 * model.track_m + 0.3
        joint = rear + model.rear_to_joint_m * _unit(yaw)
        outlines.append(_strip(rear - 1.2 * _unit(yaw), joint, half))
        outlines.append(_strip(joint, joint + (model.front_to_joint_m + 1.2) * _unit(yaw + bend), half))
    return outlines


def _unit(yaw_rad: float) -> Floats:
    return np.array([np.cos(yaw_rad), np.sin(yaw_rad)])


def _strip(start: Floats, end: Floats, half_m: float) -> Floats:
    ahead = (end - start) / np.hypot(*(end - start))
    left = half_m * np.array([-ahead[1], ahead[0]])
    return np.array([start + left, end + left, end - left, start - left])


def _ground(client: int, terrain: Terrain, shades: list[Floats], folder: Path) -> None:
    """Create the ground as a mesh textured with its zones."""
    rows, columns = terrain.heights_m.shape
    size_m = (columns - 1) * terrain.cell_m, (rows - 1) * terrain.cell_m
    mesh_m = max(MESH_M, float(np.sqrt(np.prod(size_m) / MAX_NODES)))
    east, north = (np.linspace(0, side, round(side / mesh_m) + 1) for side in size_m)
    x, y = np.meshgrid(east, north)
    texture, mesh = folder / "ground.png", folder / "ground.obj"
    cv2.imwrite(str(texture), _picture(terrain, shades, float(east[-1]), float(north[-1])))
    z = terrain.height(x, y)
    mesh.write_text(_wavefront(x, y, z), encoding="ascii")
    shape = pybullet.createVisualShape(pybullet.GEOM_MESH, fileName=str(mesh), physicsClientId=client)
    body = pybullet.createMultiBody(0, -1, shape, physicsClientId=client)
    picture = pybullet.loadTexture(str(texture), client)
    pybullet.changeVisualShape(
        body, -1, textureUniqueId=picture, rgbaColor=[1, 1, 1, 1], specularColor=[0, 0, 0], physicsClientId=client
    )
    for name, side in {"south": (x[0], y[0], z[0]), "east": (x[:, -1], y[:, -1], z[:, -1])}.items():
        _skirt(client, folder / f"{name}.obj", np.array(side), float(z.min()) - SKIRT_M)


def _skirt(client: int, path: Path, edge: Floats, floor_m: float) -> None:
    """Close the side below an edge (3, k) of the ground, so that the site looks solid."""
    x, y, z = (
        np.stack([below, above])
        for below, above in zip((*edge[:2], np.full(edge.shape[1], floor_m)), edge, strict=True)
    )
    path.write_text(_wavefront(x, y, z), encoding="ascii")
    shape = pybullet.createVisualShape(
        pybullet.GEOM_MESH, fileName=str(path), rgbaColor=SKIRT_RGBA, specularColor=[0, 0, 0], physicsClientId=client
    )
    pybullet.createMultiBody(0, -1, shape, physicsClientId=client)


def _picture(terrain: Terrain, shades: list[Floats], width_m: float, depth_m: float) -> AnyArray:
    """Zones from above, blurred and grained, dark under machines; north up."""
    texel_m = max(TEXEL_M, float(np.sqrt(width_m * depth_m / MAX_TEXELS)))
    x = np.arange(texel_m / 2, width_m, texel_m)
    y = np.arange(texel_m / 2, depth_m, texel_m)[::-1]
    grid = np.meshgrid(x, y)
    zone = terrain.zone(*grid)
    colours = np.array([z.bgr for z in ZONES], float)
    picture = 0.62 * cv2.GaussianBlur(colours[zone], (0, 0), 3) + 62.0
    noise = np.random.default_rng(0).standard_normal(zone.shape)
    grain = cv2.GaussianBlur(noise, (0, 0), 1) * 2 + cv2.GaussianBlur(noise, (0, 0), 6) * 12
    east, north = terrain.gradient(*grid)
    relief = -RELIEF * cv2.GaussianBlur(SUN[0] * east + SUN[1] * north, (0, 0), 6)
    light: AnyArray = np.ones(zone.shape)
    for outline in shades:
        texels = np.round((outline * [1, -1] + [0, depth_m]) / texel_m).astype(np.int32)
        cv2.fillPoly(light, [texels], 1 - SHADE)
    light = cv2.GaussianBlur(light, (0, 0), 4) * (1 + GRAIN * grain + relief)
    image: AnyArray = np.clip(picture * light[..., None], 0, 255).astype(np.uint8)
    return image


def _wavefront(x: Floats, y: Floats, z: Floats) -> str:
    """A grid of nodes as a textured Wavefront OBJ mesh."""
    rows, columns = x.shape
    vertices = [f"v {a:.3f} {b:.3f} {c:.3f}" for a, b, c in zip(x.ravel(), y.ravel(), z.ravel(), strict=True)]
    u, v = x / max(x.max(), 1.0), y / max(y.max(), 1.0)
    places = [f"vt {a:.5f} {b:.5f}" for a, b in zip(u.ravel(), v.ravel(), strict=True)]
    corner: Ints = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1) + 1).ravel()
    faces = []
    for a, b, c, d in zip(
        *(k.tolist() for k in (corner, corner + 1, corner + columns + 1, corner + columns)), strict=True
    ):
        faces += [f"f {a}/{a} {b}/{b} {c}/{c}", f"f {a}/{a} {c}/{c} {d}/{d}"]
    return "\n".join([*vertices, *places, *faces]) + "\n"


def _photograph(client: int, camera: Camera) -> AnyArray:
    view = pybullet.computeViewMatrixFromYawPitchRoll(
        camera.target_m, camera.distance_m, camera.yaw_deg, -camera.pitch_deg, 0, 2
    )
    far = 4 * camera.distance_m
    lens = pybullet.computeProjectionMatrixFOV(camera.view_deg, camera.width / camera.height, far / 1000, far)
    _, _, rgba, _, bodies = pybullet.getCameraImage(
        camera.width,
        camera.height,
        view,
        lens,
        lightDirection=SUN,
        lightColor=[1, 1, 1],
        lightDistance=camera.distance_m,
        lightAmbientCoeff=0.55,
        lightDiffuseCoeff=0.5,
        lightSpecularCoeff=0.05,
        shadow=1,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=client,
    )
    image = np.reshape(rgba, (camera.height, camera.width, 4))[..., :3].astype(np.uint8)
    empty = np.reshape(bodies, (camera.height, camera.width)) < 0
    image[empty] = SKY_RGB
    return image[..., ::-1].copy()
