"""Memory of a process from the kernel."""

from __future__ import annotations

from pathlib import Path


def memory_mb(name: str = "VmRSS", pid: int | None = None) -> float:
    """Resident memory of a process, or with VmHWM its peak; getrusage would include a parent's."""
    lines = Path(f"/proc/{pid or 'self'}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name)) * 1024 / 1e6
