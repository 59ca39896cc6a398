"""Kept kernels that are stale: Numba looks at the file of a kernel, not at what it takes from other modules.

So a clone that was pulled could read samples of today by the layout of yesterday. An installed package cannot.
"""

from __future__ import annotations

import re
import zlib
from contextlib import suppress
from pathlib import Path

PACKAGES = ("mapserver", "protocol", "sim")  # with kernels, and with what these are made of
STAMP = Path("mapserver") / "__pycache__" / "kernels.crc"  # of the sources that kept kernels are of
_IMPORT = re.compile(rb"^from ([\w.]+) import (.+)$", re.MULTILINE)


def drop_stale(root: Path = Path(__file__).parents[2]) -> int:
    """Remove the kernels of a clone once modules with kernels, or that they import, changed; returns how many files.

    root: of the clone. Where its files may not be written nothing is removed, and nothing was kept.
    """
    if not (root / ".git").exists():
        return 0
    checksum, stamp, removed = _checksum(root), root / STAMP, 0
    with suppress(OSError):
        if stamp.is_file() and stamp.read_text() == str(checksum):
            return 0
        for path in [path for package in PACKAGES for path in (root / package).rglob("*.nb?")]:
            path.unlink(missing_ok=True)
            removed += 1
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(str(checksum))
    return removed


def _checksum(root: Path) -> int:
    """Of all modules with kernels, and of those that they import."""
    sources = {path: path.read_bytes() for package in PACKAGES for path in (root / package).rglob("*.py")}
    of_kernels = {path for path, text in sources.items() if b"njit" in text}
    for path in list(of_kernels):
        for module, names in _IMPORT.findall(sources[path]):
            place = root.joinpath(*module.decode().split("."))
            inner = re.findall(r"\w+", names.decode())
            of_kernels |= {place.with_suffix(".py"), *(place / f"{name}.py" for name in inner)}
    checksum = 0
    for path in sorted(of_kernels & sources.keys()):
        checksum = zlib.crc32(sources[path], checksum)
    return checksum
