"""Digests that tell versions of code and of options apart, for the names of files that are kept."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import cache
from pathlib import Path

ROOT = Path(__file__).parents[2]
SUFFIXES = (".py", ".toml", ".urdf")


@cache
def code_version(*names: str) -> str:
    """Digest of the sources of packages or modules, as paths from the project's root; raises FileNotFoundError."""
    files = sorted(path for name in names for path in _sources(ROOT / name))
    return digest(*(f"{path.relative_to(ROOT)}\n{path.read_text(encoding='utf-8')}" for path in files))


def digest(*texts: str) -> str:
    """Ten hex digits that tell texts apart."""
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:10]


def _sources(path: Path) -> Iterable[Path]:
    if path.is_dir():
        return (inner for inner in path.rglob("*") if inner.suffix in SUFFIXES)
    return [path]  # reading it raises where it is not there
