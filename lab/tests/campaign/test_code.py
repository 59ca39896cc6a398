"""Code version: a module, its imports in this project, and data."""

import ast
from pathlib import Path

import pytest

from lab.campaign import code

FILES = {
    "solver.py": "from lib.maths import add\n\n\ndef solve():\n    import late\n",
    "lib/__init__.py": "",
    "lib/maths.py": "import lib.deeper.constants as c\nimport numpy\n",
    "lib/deeper/__init__.py": "",
    "lib/deeper/constants.py": "G = 9.81\n",
    "lib/deeper/presets.toml": "a = 1\n",
    "late.py": "x = 1\n",
    "other.py": "y = 1\n",
}


@pytest.fixture(autouse=True)
def project(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setattr(code, "ROOT", tmp_path)
    for name, text in FILES.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def version(*modules: str) -> str:
    return code.code_version.__wrapped__(*modules)


@pytest.mark.parametrize("name", FILES)
def test_it_changes_with_whatever_is_imported_and_with_nothing_else(project: Path, name: str):
    before = version("solver")
    (project / name).write_text(f"{FILES[name]}z = 2\n")
    assert (version("solver") == before) == (name == "other.py")
    (project / name).write_text(FILES[name])
    assert version("solver") == before != version("solver", "other")


def test_what_is_only_said_in_another_way_is_the_same(project: Path):
    sources = (
        'def f(x):\n    return {"a": x}\n',
        '"""A module."""\n\ndef f(x):  # of x\n    """A function."""\n    return {\n        "a": x,\n    }\n',
        'def f(x):\n    return {"b": x}\n',
        'def f(x):\n    "a"\n',
    )
    seen = []
    for source in sources:
        (project / "late.py").write_text(source)
        seen.append(version("late"))
    assert seen[0] == seen[1]
    assert len(set(seen)) == 3


def test_nothing_that_results_are_made_of_is_imported_by_a_name_made_at_run_time():
    """They would be missed; libraries may do it."""
    root = Path(__file__).parents[3]
    for package in ("agents", "mapserver", "protocol", "sim"):
        for path in (root / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and ast.unparse(node.func).endswith("import_module"):
                    assert ast.unparse(node.args[0]).lstrip("f").strip("'\"").startswith(("fsspec", "pyarrow")), path
