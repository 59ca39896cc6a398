"""Fixtures: a construction site of real processes, every one of them ended with the test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from sitegrid.process.children import Children
from tests.integration.browser_tab import launched
from tests.integration.site_run import SiteRun  # beside this file


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    yield from launched()


@pytest.fixture
def children(tmp_path: Path) -> Iterator[Children]:
    with Children(tmp_path) as started:
        yield started


@pytest.fixture
def site_run(tmp_path: Path, children: Children) -> SiteRun:
    return SiteRun(
        tmp_path, children, free_endpoint(), SimConfig(machines=3, seconds=40, speed=8, seed=3, world="pybullet")
    )
