"""Paths for tests."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).parents[1]
CONFIG = ROOT / "config"
DOCS = ROOT / "docs"
GOLDEN = ROOT / "tests" / "golden"
SHARED_DATA = ROOT.parent / "shared" / "data"  # real logs, if at hand
