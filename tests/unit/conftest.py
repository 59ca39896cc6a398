"""Numba's kernels are compiled before the first test that needs them is timed, also on a fresh clone."""

from __future__ import annotations

import pytest

from mapserver.change.detection import ChangeConfig, cuts
from mapserver.config import ServerConfig
from mapserver.server import warm_up
from sim.worlds.fast import FastWorld
from tests.unit.mapserver.data import NOW_NS, folded, samples
from tests.unit.sim.planes import LOADER, idle, placed, plane


@pytest.fixture(scope="session", autouse=True)
def _compiled_kernels() -> None:
    """Compile the kernels, or read them from their cache, once: no single test pays for it."""
    warm_up(ServerConfig())
    (pages,) = folded(samples(2, stamp_ns=[NOW_NS, NOW_NS + 10**12], c_rr=[0.01, 0.3])).pages([(0, 0)])
    cuts(pages, ChangeConfig())
    with placed(FastWorld, plane(0), LOADER) as world:
        idle(world, 0.01)
