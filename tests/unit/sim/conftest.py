"""Numba's kernels are compiled before the first test that needs them is timed."""

import pytest

from sim.worlds.fast import FastWorld
from tests.unit.sim.planes import LOADER, idle, placed, plane


@pytest.fixture(scope="session", autouse=True)
def _compiled_kernels() -> None:
    """Compile, or load from the cache, once per session."""
    with placed(FastWorld, plane(0), LOADER) as world:
        idle(world, 0.01)
