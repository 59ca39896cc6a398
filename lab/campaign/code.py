"""Code and data that a result depends on: a module and its imports in this project."""

from __future__ import annotations

import ast
import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
DATA = (".toml", ".urdf")
JUDGED_ANEW = "goals.toml"  # judges results, does not change them
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@cache
def code_version(*modules: str) -> str:
    """Digest of modules with all their imports; ModuleNotFoundError if one is not in this project.

    Comments, docstrings and layout are excluded, so that results survive rewording.
    """
    if missing := [name for name in modules if _path(name) is None]:
        raise ModuleNotFoundError(missing[0])
    files, waiting = dict[Path, str](), [*modules]
    while waiting:
        path = _path(name := waiting.pop())
        if path and path not in files:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            waiting += [*_imported(tree), name.rpartition(".")[0]]
            files[path] = _counting(tree)
    folders = {file.parent for file in files}
    data = [path for folder in folders for path in folder.iterdir() if path.suffix in DATA and path.name != JUDGED_ANEW]
    files |= {path: path.read_text(encoding="utf-8") for path in data}
    return digest(*(f"{path.relative_to(ROOT)}\n{files[path]}" for path in sorted(files)))


def digest(*texts: str) -> str:
    """Ten hex digits that distinguish texts."""
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:10]


def _path(name: str) -> Path | None:
    """File of a module of this project, else None."""
    path = ROOT.joinpath(*name.split("."))
    return next((file for file in (path.with_suffix(".py"), path / "__init__.py") if name and file.is_file()), None)


def _imported(tree: ast.Module) -> Iterator[str]:
    """Possible module names, including imports in functions."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (each.name for each in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{each.name}" for each in node.names)


def _counting(tree: ast.Module) -> str:
    """The syntax tree without docstrings."""
    for node in ast.walk(tree):
        if isinstance(node, _DOCUMENTED) and ast.get_docstring(node, clean=False) is not None:
            del node.body[0]
    return ast.dump(tree)
