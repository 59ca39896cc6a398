import numpy as np
from sim_bullet_worlds import LOADER, bullet, plane

from sim.render import SKY_RGB, Camera, closeup, overview, render
from sim.soil import GRAVEL


def test_machine_ground_and_sky_are_in_the_picture() -> None:
    terrain = plane(GRAVEL)
    terrain = type(terrain)(np.zeros((3, 3)), 15.0, terrain.zones, 1000.0)
    with bullet(terrain, LOADER, starts=[(15, 15, 0.5)]) as world:
        camera = closeup(world.state, 0)
        small = Camera(camera.target_m, camera.distance_m, camera.yaw_deg, 10.0, width=320, height=180)
        image = render(terrain, [LOADER], world.state, small)
        empty = render(terrain, [], world.state, small)
    assert image.shape == (180, 320, 3)
    assert (image[0, 0] == SKY_RGB[::-1]).all()
    blue, _, red = image[-1].mean(axis=0)
    assert red > 1.5 * blue  # gravel is red
    changed = (image.astype(int) - empty).any(axis=-1)
    assert changed[60:140, 100:220].mean() > 0.2
    yellow = (image[..., 2] > 150) & (image[..., 1] > 100) & (image[..., 0] < 60)
    assert yellow.sum() > 100


def test_overview_sees_the_whole_site() -> None:
    terrain = plane(GRAVEL)
    terrain = type(terrain)(np.zeros((4, 5)), 50.0, terrain.zones, 1000.0)
    assert overview(terrain).target_m[0] == 103.0
    assert overview(terrain).distance_m > 150
