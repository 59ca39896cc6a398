import numpy as np
import pytest

from sim.pictures import render as render_module
from sim.pictures.render import SKY_RGB, Camera, closeup, overview, render
from sim.terrain.terrain import GRAVEL
from sim.worlds.fast import FastWorld
from tests.unit.sim.planes import LOADER, placed, plane


def test_machine_ground_and_sky_are_in_the_picture() -> None:
    terrain = plane(GRAVEL)
    terrain = type(terrain)(np.zeros((3, 3)), 15.0, terrain.zones, 1000.0)
    with placed(FastWorld, terrain, LOADER, starts=[(15, 15, 0.5)]) as world:
        camera = closeup(world.state, 0, LOADER)
        small = Camera(camera.target_m, camera.distance_m, camera.yaw_deg, 10.0, width=320, height=180)
        (image,) = render(terrain, [LOADER], world.state, [small])
        (empty,) = render(terrain, [], world.state, [small])
    assert image.shape == (180, 320, 3)
    assert (image[0, 0] == SKY_RGB[::-1]).all()
    blue, _, red = image[-1].mean(axis=0)
    assert blue > 1.2 * red  # gravel is greyish blue
    changed = (image.astype(int) - empty).any(axis=-1)
    assert changed[60:140, 100:220].mean() > 0.2
    yellow = (image[..., 2] > 150) & (image[..., 1] > 100) & (image[..., 0] < 60)
    assert yellow.sum() > 100


@pytest.mark.parametrize(("rows", "columns", "width", "height"), [(3, 9, 90, 120), (7, 2, 160, 90)])
def test_overview_sees_the_whole_site_and_fills_its_frame(rows, columns, width, height, monkeypatch) -> None:
    monkeypatch.setattr(render_module, "TEXEL_M", 5.0)
    flat = plane(GRAVEL)
    terrain = type(flat)(np.zeros((rows, columns)), 50.0, flat.zones, 1000.0)
    with placed(FastWorld, terrain, LOADER, starts=[(15, 15, 0.5)]) as world:
        (image,) = render(terrain, [], world.state, [overview(terrain, width, height)])
    ground = (image != SKY_RGB[::-1]).any(axis=-1)
    assert not any(edge.any() for edge in (ground[0], ground[-1], ground[:, 0], ground[:, -1]))
    spans = [np.ptp(np.flatnonzero(ground.any(axis=axis))) + 1 for axis in (0, 1)]
    assert max(spans[0] / width, spans[1] / height) > 0.9
