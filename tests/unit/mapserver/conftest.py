"""What the tests of the map server share."""

from __future__ import annotations

import pytest

from mapserver.evidence import cells as ev
from mapserver.evidence.grid import warm_up
from mapserver.evidence.pages import moments
from mapserver.evidence.votes import FoldConfig
from tests.unit.mapserver.data import folded, samples


@pytest.fixture(scope="session", autouse=True)
def _compiled_kernels() -> None:
    """Compile the kernels, or read them from their cache, once: no single test pays for it."""
    warm_up(FoldConfig())
    moments(folded(samples(1)).state().pages[0].page, ev.HEADING)
