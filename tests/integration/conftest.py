"""Fixtures: sites of real processes, all ended with the test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from protocol.wire.session import free_endpoint
from sim.config import SimConfig
from tests.integration.browser_tab import launched
from tests.integration.forks import Forks
from tests.integration.hauling_site import hauling_site
from tests.integration.site_run import NOBODY_DRIVES, SiteRun  # beside this file
from tests.integration.web_site import WebSite


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    yield from launched()


@pytest.fixture(scope="session")
def web(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebSite]:
    """A site on the web after a minute of driving; tests read or drive on."""
    folder = tmp_path_factory.mktemp("web")
    with Forks(folder) as started:
        site = WebSite(folder, started, "--host", "map.example")
        site.drive(60)
        yield site


@pytest.fixture(scope="session")
def hauling(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WebSite]:
    """A read-only site on the web after four days of haulers."""
    folder = tmp_path_factory.mktemp("hauling")
    with Forks(folder) as started:
        yield hauling_site(folder, started)


@pytest.fixture
def children(tmp_path: Path) -> Iterator[Forks]:
    with Forks(tmp_path) as started:
        yield started


@pytest.fixture
def site(tmp_path: Path, children: Forks) -> SiteRun:
    """A site without drivers, not started."""
    return SiteRun(tmp_path, children, free_endpoint(), NOBODY_DRIVES)


@pytest.fixture
def site_run(tmp_path: Path, children: Forks) -> SiteRun:
    return SiteRun(
        tmp_path, children, free_endpoint(), SimConfig(machines=3, seconds=40, speed=8, seed=3, world="pybullet")
    )
