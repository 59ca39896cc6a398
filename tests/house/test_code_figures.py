"""Figures of the house, on a small checkout."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.import_levels import layering
from tests.paths import ROOT
from tests.structure import AREAS, LABORATORY, LABORATORY_TESTS, PRODUCT, TESTS, figures, modules, packages, table

A = '''"""Four words of docstring."""

from core import b

A, B = 1, -2.5  # and two
NAME = "x"
C: int = 60 * A
'''
B = '''def f(add):
    """Two words."""
    add("--flag", "--other")
    return 7


SIZES = (1, 2)
MADE = len("x")
'''
LINTED = '[tool.importlinter]\nroot_packages = ["core", "lab"]\n[[tool.importlinter.contracts]]\nname = "one"\n'
FILES = {
    "pyproject.toml": LINTED,
    "core/__init__.py": '"""One two three."""\n',
    "core/a.py": A,
    "core/b.py": B,
    "lab/__init__.py": "import core.a\n",
    "lab/tests/test_lab.py": "def test_it():\n    assert 1\n",
    "tests/test_core.py": "def test_it():\n    assert 1\n\n\ndef test_more():\n    pass\n",
    "tests/unit/lab/test_old.py": "X = 3\n",
    "README.md": "five words stand right here\n",
    "lab/README.md": "two words\n",
    **{f"config/{name}.toml": "[one]\ntwo = 3\n" for name in ("agent", "server", "sim")},
}


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    for words in (["init", "-q"], ["add", "."]):
        subprocess.run(["git", *words], cwd=tmp_path, check=True)
    return tmp_path


def test_modules_are_counted_where_they_belong(checkout: Path) -> None:
    measured = figures(checkout)
    assert packages(checkout) == ("core", "lab")
    counted = {area: (values["modules"], values["functions"]) for area, values in measured["areas"].items()}
    assert counted == {PRODUCT: (3, 1), LABORATORY: (1, 0), LABORATORY_TESTS: (2, 1), TESTS: (1, 2)}
    assert measured["packages"]["core"]["lines"] == sum(
        FILES[f"core/{name}.py"].count("\n") for name in ("__init__", "a", "b")
    )
    assert measured["document_words"] == {PRODUCT: 5, LABORATORY: 2}
    assert measured["options"] == {"agent": 1, "server": 1, "sim": 1, "described": 0}


def test_constants_flags_and_words_are_counted(checkout: Path) -> None:
    product = figures(checkout)["areas"][PRODUCT]
    assert product["numeric constants"] == 4  # A, B, C, SIZES; no texts, no results of calls
    assert product["flags"] == 2
    assert product["words in docstrings and comments"] == 3 + 4 + 2 + 2
    assert (product["import levels"], product["import circles"]) == (2, 0)


def test_a_file_that_git_does_not_track_does_not_count(checkout: Path) -> None:
    (checkout / "core" / "new.py").write_text("X = 1\n")
    assert "core/new.py" not in {str(module.path) for module in modules(checkout, "core")}


@pytest.mark.parametrize(
    ("imports", "levels", "circles"),
    [
        ({}, 0, 0),
        ({"a": []}, 1, 0),
        ({"a": ["b"], "b": ["c"], "c": [], "d": ["c", "elsewhere"]}, 3, 0),
        ({"a": ["b"], "b": ["a"]}, 1, 1),
        ({"top": ["a"], "a": ["b"], "b": ["c"], "c": ["a", "low"], "low": []}, 3, 1),
        ({"a": ["b"], "b": ["a"], "c": ["d"], "d": ["c", "a"]}, 2, 2),
    ],
)
def test_levels_take_a_circle_for_one(imports: dict[str, list[str]], levels: int, circles: int) -> None:
    assert layering(imports) == (levels, circles)


@pytest.mark.slow
def test_it_is_printed_as_a_table_and_as_json(checkout: Path) -> None:
    command = [sys.executable, "-m", "tests.structure", str(checkout)]
    printed, listed = (
        subprocess.run([*command, *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout
        for words in ([], ["--json"])
    )
    assert json.loads(listed) == figures(checkout)
    assert printed == table(figures(checkout)) + "\n"
    assert all(area in printed.splitlines()[0] for area in AREAS)
