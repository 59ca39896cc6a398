"""docs/guarantees.md: every claim has rows of fault, history and verdict, naming existing things."""

import re

from tests.chaos.__main__ import FAULTS
from tests.paths import DOCS, ROOT

PAGE = (DOCS / "guarantees.md").read_text()
CLAIMS, REST = re.split(r"^## Histories$", PAGE, maxsplit=1, flags=re.MULTILINE)
VERDICTS = ("holds", "in part", "open")


def _rows(text: str) -> list[list[str]]:
    """Cells of all tables, without heads."""
    lines = [
        line for line in text.splitlines() if line.startswith("| ") and not line.startswith(("| fault |", "| ---"))
    ]
    return [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in lines]


def _names(text: str) -> set[str]:
    return {name for row in _rows(text) for name in re.findall(r"`(\w+)`", row[0])}


def test_every_fault_of_the_suite_is_described_and_tests_a_claim() -> None:
    names = {fault.name for fault in FAULTS}
    assert names - _names(REST) == set(), "rows in `The faults`"
    assert names - _names(CLAIMS) == set(), "rows below a claim"


def test_every_row_has_a_fault_a_history_and_a_verdict() -> None:
    assert [row for row in _rows(CLAIMS) if len(row) != 3 or not row[2].startswith(VERDICTS)] == []


def test_every_claim_has_a_table() -> None:
    claims = re.split(r"^### ", CLAIMS, flags=re.MULTILINE)[1:]
    # The first two share theirs, since a losing fault may double as well.
    assert [claim.splitlines()[0] for claim in claims[1:] if not _rows(claim)] == []


def test_the_tests_that_verdicts_name_exist() -> None:
    tests = "\n".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    assert [name for name in re.findall(r"`(test_\w+)`", PAGE) if f"def {name}(" not in tests] == []
