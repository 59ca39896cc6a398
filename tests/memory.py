"""Memory of a process, as its kernel counts it."""

from __future__ import annotations

from pathlib import Path


def memory_mb(name: str = "VmRSS", pid: int | None = None) -> float:
    """Memory of this process or another: resident now, or with VmHWM the most that ever was.

    getrusage would count a parent's too.
    """
    lines = Path(f"/proc/{pid or 'self'}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) * 1024 / 1e6
