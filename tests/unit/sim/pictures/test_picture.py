import cv2
import numpy as np
import pytest

from protocol.site.ground_classes import ZONES
from sim.config import SimConfig
from sim.pictures import picture
from sim.pictures import render as render_module
from sim.pictures.canvas import Canvas
from sim.pictures.plan import draw_plan
from sim.pictures.render import render
from sim.simulator import Simulator


def plan(monkeypatch: pytest.MonkeyPatch, scenario: str, **options: object) -> tuple[np.ndarray, list[str]]:
    """A scenario's plan, and its labels."""
    written: list[str] = []
    label = Canvas.label

    def noted(self: Canvas, words: str, *rest: object) -> bool:
        has_room = label(self, words, *rest)
        written.extend([words] * has_room)
        return has_room

    monkeypatch.setattr(Canvas, "label", noted)
    simulator = Simulator(SimConfig(scenario=scenario, world="fast", **options))
    try:
        return draw_plan(simulator.scenario, simulator.models, simulator.state), written
    finally:
        simulator.close()


@pytest.mark.slow
def test_the_plan_names_routes_machines_and_slope(monkeypatch) -> None:
    image, written = plan(monkeypatch, "paper_site")
    machines, routes = ["loader-1", "loader-2", "loader-3"], ["west", "east", "middle"]
    assert sorted(written) == sorted([*machines, *routes, "15 deg uphill"])
    pale = [[round(0.6 * c + 102) for c in zone.bgr] for zone in ZONES]
    assert all((image == colour).all(axis=-1).any() for colour in pale)


HAUL = {"loads 22 t in 30 s", "dumps 22 t in 15 s", "loads 4.5 t in 6 s", "dumps 4.5 t in 4 s"}
CHANGES = {"after 150 s: dry concrete", "after 200 s: wet dirt"}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scenario", "labels"),
    [
        ("haul_road", HAUL | {"9 deg uphill", "5 deg uphill"}),
        ("repaved", CHANGES),
        ("bad_machine", {"loader-2, faulty"}),
    ],
)
def test_the_plan_tells_of_stops_changes_and_faults(monkeypatch, scenario: str, labels: set[str]) -> None:
    assert labels <= set(plan(monkeypatch, scenario)[1])


@pytest.mark.slow
def test_one_picture_is_written(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(picture, "DRIVE_S", 1.0)
    monkeypatch.setattr(render_module, "TEXEL_M", 1.0)
    cameras = []
    monkeypatch.setattr(picture, "render", lambda *scene: cameras.extend(scene[-1]) or render(*scene))
    path = tmp_path / "haul.png"
    assert picture.draw(SimConfig(scenario="haul_road", world="fast"), path) == [path]
    assert [entry.name for entry in tmp_path.iterdir()] == ["haul.png"]
    height, width, _ = cv2.imread(str(path)).shape
    assert 1200 <= width <= 1850
    assert height <= 1850
    assert len(cameras) == 3  # site, truck, loader
