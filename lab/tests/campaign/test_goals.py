"""Goals as data."""

from pathlib import Path

import pytest

from lab.campaign import goals as module
from lab.campaign.figures import Goal
from lab.campaign.goals import goals

FILE = """
[[a]]
row = { case = "x" }
wrong_pct = [">= 0.5", "<= 1"]
[[a]]
row = { case = "y", machines = 2 }
known_pct = ">= 98"
[[b]]
row = {}
wrong_pct = "< 1"
"""


def test_a_goal_is_read_from_each_limit(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(module, "FILE", tmp_path / "goals.toml")
    module.FILE.write_text(FILE)
    assert goals("a") == (
        Goal({"case": "x"}, "wrong_pct", ">=", 0.5),
        Goal({"case": "x"}, "wrong_pct", "<=", 1.0),
        Goal({"case": "y", "machines": 2}, "known_pct", ">=", 98.0),
    )
    with pytest.raises(AssertionError, match="wrong_pct: < 1"):
        goals("b")
