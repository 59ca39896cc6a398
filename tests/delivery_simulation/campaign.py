"""Many seeds, one after the other, in a folder that lies in memory where there is one."""

from __future__ import annotations

import shutil
import tempfile
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.delivery_simulation.world import Verdict, World

IN_MEMORY = Path("/dev/shm")


def run_one(seed: int, *, real: bool = False, say: Callable[[str], None] | None = None) -> Verdict:
    """Run one world; an error in it is a failure of this seed."""
    folder = Path(tempfile.mkdtemp(prefix="sitegrid-", dir=IN_MEMORY if IN_MEMORY.is_dir() else None))
    try:
        world = World(seed, folder, real=real, say=say)
        try:
            return world.run()
        finally:
            world.close()
    except Exception as error:
        if say:
            raise
        return Verdict(seed, problems=[f"{type(error).__name__}: {error}"])
    finally:
        shutil.rmtree(folder)


def run_seeds(
    first: int, n: int, *, real: bool = False, say: Callable[[str], None], stop_at_failure: bool = False
) -> dict[str, Any]:
    """Run `n` worlds; the sums over them, and what happened in them. Each that fails is told with how to replay it."""
    sums: Counter[str] = Counter()
    events: Counter[str] = Counter()
    failed: list[int] = []
    for seed in range(first, first + n):
        verdict = run_one(seed, real=real)
        for name in ("recorded", "journalled", "explained", "lost", "double"):
            sums[name] += getattr(verdict, name)
        events.update(verdict.events)
        if not verdict.is_good:
            failed.append(seed)
            problem = "; ".join(verdict.problems)
            replay = f"python -m tests.delivery_simulation --seed {seed} --trace{' --real' if real else ''}"
            say(f"seed {seed}: lost {verdict.lost}, double {verdict.double} {problem}  replay: {replay}")
            if stop_at_failure:
                break
    return {"seeds": n, "failed": len(failed), "failed_seeds": failed[:20], **sums, "events": dict(events)}
