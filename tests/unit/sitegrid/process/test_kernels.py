"""Kernels that are kept are those of today's sources."""

from __future__ import annotations

from pathlib import Path

from sitegrid.process.kernels import PACKAGES, drop_stale


def clone(folder: Path) -> list[Path]:
    """A clone in which a kernel is made of a layout in another package, with its kept kernel and another one."""
    (folder / ".git").mkdir()
    for name in PACKAGES:
        (folder / name / "__pycache__").mkdir(parents=True)
        (folder / name / "layout.py").write_text("WIDTH = 80\n")
    (folder / "mapserver" / "fold.py").write_text("from numba import njit\nfrom protocol.layout import WIDTH\n")
    return [folder / name / "__pycache__" / "fold.f-1.py311.nbi" for name in PACKAGES]


def test_kernels_go_when_what_they_are_made_of_changes_and_stay_otherwise(tmp_path: Path):
    kernels = clone(tmp_path)

    def kept_after(change: str, text: str) -> bool:
        for path in kernels:
            path.touch()
        (tmp_path / change).write_text(text)
        assert drop_stale(tmp_path) in (0, len(kernels))
        return all(path.exists() for path in kernels)

    drop_stale(tmp_path)
    assert kept_after("sim/layout.py", "WIDTH = 81\n")
    assert not kept_after("protocol/layout.py", "WIDTH = 88\n")
    assert kept_after("protocol/layout.py", "WIDTH = 88\n")
    assert not kept_after("mapserver/fold.py", "from numba import njit\nfrom protocol import layout\n")
    assert not kept_after("protocol/layout.py", "WIDTH = 96\n")


def test_an_installed_package_keeps_its_kernels(tmp_path: Path):
    kernels = clone(tmp_path)
    (tmp_path / ".git").rmdir()
    kernels[0].touch()
    assert drop_stale(tmp_path) == 0
    assert kernels[0].exists()
