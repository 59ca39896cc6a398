"""Settings for all tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

from tests.paths import ROOT, SHARED_DATA

# Repeatable on every machine, and no complaint about a slow one.
settings.register_profile("repeatable", derandomize=True, deadline=None, database=None, print_blob=True)
settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def root() -> Path:
    """The project's root."""
    return ROOT


@pytest.fixture(scope="session")
def husky_data() -> Path:
    """The real Husky log; skipped where it is not at hand."""
    folder = SHARED_DATA / "rl_test1_husky"
    if not folder.exists():
        pytest.skip("the Husky log is not beside the project (../shared/data/rl_test1_husky)")
    return folder


@pytest.fixture(autouse=True)
def _at_root(monkeypatch: pytest.MonkeyPatch) -> None:
    """Child processes find the packages from wherever pytest was started."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
