"""A rendered view of a site and its machines, by PyBullet's software renderer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pybullet

from protocol.arrays import AnyArray, Floats, Ints
from protocol.ground import ZONES
from sim.machine_model import FOLDER, MachineModel
from sim.terrain import Terrain
from sim.world import FleetState

MESH_M = 1.0  # between the nodes of the drawn ground
TEXTURE_M = 0.1  # size of a texel
SKY_RGB = (196, 214, 232)
GRAIN = 0.06  # brightness noise of the ground, so that an eye sees it move and bend
SUN = (-0.8, 0.45, 1.0)  # in the north-west, as on maps: slopes that face it are brighter
RELIEF = 1.1  # how much brighter, per unit of gradient
SHADE = 0.5  # of the ground under a machine
SKIRT_M = 5.0  # depth of the block that the site is cut out of
SKIRT_RGBA = (0.42, 0.36, 0.30, 1.0)


@dataclass(frozen=True)
class Camera:
    """Where to look at [m], from how far, turned from north clockwise, and from how high above the horizon [deg]."""

    target_m: tuple[float, float, float]
    distance_m: float
    yaw_deg: float = 25.0
    pitch_deg: float = 35.0
    view_deg: float = 45.0
    width: int = 1280
    height: int = 720


def overview(terrain: Terrain) -> Camera:
    """A camera that sees the whole site."""
    depth, width = (terrain.cell_m * (n - 1) for n in terrain.heights_m.shape)
    middle = float(terrain.heights_m.mean())
    return Camera((width * 0.515, depth * 0.41, middle), 0.95 * max(width, 1.3 * depth), yaw_deg=20.0, pitch_deg=43.0)


def closeup(state: FleetState, machine: int) -> Camera:
    """A camera beside and ahead of one machine."""
    x, y, z, yaw = (float(v[machine]) for v in (state.x_m, state.y_m, state.z_m, state.yaw_rad))
    ahead_m = 2.0  # about the middle of a machine
    target = (x + ahead_m * np.cos(yaw), y + ahead_m * np.sin(yaw), z + 1.0)
    return Camera(target, 13.0, yaw_deg=float(np.degrees(yaw)) + 35.0, pitch_deg=22.0)


def render(terrain: Terrain, models: Sequence[MachineModel], state: FleetState, camera: Camera) -> AnyArray:
    """Draw the machines of a state on their ground: (height, width, 3) uint8; blue, green, red as OpenCV has it."""
    client = pybullet.connect(pybullet.DIRECT)
    try:
        with TemporaryDirectory() as folder:
            _ground(client, terrain, _shades(models, state), Path(folder))
            for machine, model in enumerate(models):
                _machine(client, model, state, machine)
            return _photograph(client, camera)
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
    """Put the ground up as a mesh with a picture of its zones on it."""
    rows, columns = terrain.heights_m.shape
    east = np.arange(0, (columns - 1) * terrain.cell_m + 1e-6, MESH_M)
    north = np.arange(0, (rows - 1) * terrain.cell_m + 1e-6, MESH_M)
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
    """Close the side below an edge (3, k) of the ground, so that the site is a block and no sheet."""
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
    """The zones from above in the paper's colours, softened and grained, dark under machines; north is up."""
    x = np.arange(TEXTURE_M / 2, width_m, TEXTURE_M)
    y = np.arange(TEXTURE_M / 2, depth_m, TEXTURE_M)[::-1]
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
        texels = np.round((outline * [1, -1] + [0, depth_m]) / TEXTURE_M).astype(np.int32)
        cv2.fillPoly(light, [texels], 1 - SHADE)
    light = cv2.GaussianBlur(light, (0, 0), 4) * (1 + GRAIN * grain + relief)
    image: AnyArray = np.clip(picture * light[..., None], 0, 255).astype(np.uint8)
    return image


def _wavefront(x: Floats, y: Floats, z: Floats) -> str:
    """A grid of nodes as a Wavefront OBJ mesh, texture stretched over it."""
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
