"""Recordings in PyBullet repeat byte for byte: figures, presets and goals come from these drives."""

import hashlib
from contextlib import closing
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from sim.config import SimConfig
from sim.simulator import Simulator
from tests.arithmetic import ARITHMETIC, arithmetic

ALL_SENSORS = SimConfig(world="pybullet", seed=3, preset="paper", gps=(1, 2, 3), imu=(1, 2, 3, 4), attitude=(1, 3, 4))
TRACK = ("stamp_ns", "x", "y", "z", "yaw", "pitch", "roll", "speed", "mass", "c_rr", "grade_e", "grade_n")


class Recorded(NamedTuple):
    """Hashes of a scenario. last_m: final places of the first and last machine."""

    seconds: float
    readings: str
    truth: str
    last_m: tuple[tuple[float, float], tuple[float, float]]


# From drivers without wander and own stops, libraries as in constraints.txt.
SCENARIOS = {
    "paper_site": Recorded(
        20.0,
        "1aab51b63a559e08cac7068ef2d6e8ac229d448b05620937e69362f1ffef4de3",
        "0cd0466cf8ec8342ceca2f1cc9e5b984423a3885d0f1df637d297791a796d8a0",
        ((92.71445873, 33.62116543), (106.77037573, 67.33281105)),
    ),
    "haul_road": Recorded(
        40.0,
        "d3f71f05dfe7788808f5a6bbc061206dc274c393c8bbd4e57824c21f6dea0987",
        "79a4bbc672fb75cdfa9da779e5b9e6abcabd8754f5e28f3ce9de47a9b4fee54d",
        ((41.99167244, 281.61370027), (343.14015706, 249.19351529)),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["paper_site", pytest.param("haul_road", marks=pytest.mark.nightly)])
def test_recordings_in_pybullet_keep_their_bytes(name: str) -> None:
    """The wheel loaders' tours, and a cycle with stops, payloads and reversing."""
    known = SCENARIOS[name]
    readings, truth = hashlib.sha256(), hashlib.sha256()
    with closing(Simulator(replace(ALL_SENSORS, scenario=name, seconds=known.seconds))) as simulator:
        for _ in range(simulator.bundles or 0):
            span = simulator.sense()
            for group in sorted(span.groups, key=lambda group: (group.kind, group.names, group.machines.tolist())):
                for column in (group.stamps_ns, group.values, group.valid):
                    readings.update(np.ascontiguousarray(column).tobytes())
        tracks = list(simulator.tracks().values())
    for track in tracks:
        for column in TRACK:
            truth.update(np.ascontiguousarray(track[column]).tobytes())
    last_m = [(track["x"][-1], track["y"][-1]) for track in (tracks[0], tracks[-1])]
    np.testing.assert_allclose(last_m, known.last_m, rtol=0, atol=1e-6)  # on every processor
    if arithmetic() == ARITHMETIC:  # other processors can only compare places
        assert (readings.hexdigest(), truth.hexdigest()) == (known.readings, known.truth)
