"""How long it takes to fold journals again, with one thread and with two, for a decision, and for maps of the past.

Each journal is folded by processes of their own, `python -m lab.speed.fold FOLDER THREADS`, in turn; it was just
written or read, so that its files are in the system's cache.
"""

from __future__ import annotations

import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from lab.speed import past
from lab.speed.fold_decision import decisions
from lab.speed.measure import Report, in_child, machine, memory_mb
from lab.speed.merge_restart import CONFIG, SITE, build
from lab.speed.merge_work import A_SECOND, BATCH, samples_of
from mapserver.evidence.grid import Grid, warm_up
from mapserver.journal.history import History
from mapserver.journal.location import JournalLocation
from mapserver.journal.refold import fold_history

LEAST_PAST_H = 2.0  # checkpoints are hourly: of less work there is none
GOALS = {
    "day_msamples_per_cpu_s": 0.9,  # with one thread
    "journal_wall_s": 45.0,  # 20 M samples
    "journal_cpu_s": 30.0,
    "two_threads": 1.5,  # times as fast as one, on an idle machine
    "decision_wall_s": 3.0,
    "point_ms_p99": 50.0,
}


def run(hours: float, samples: int, runs: int) -> Report:
    """Fold a journal of so many hours of work, and two of so many samples; distrust a machine of a real server.

    Rows: of a journal in rows of so many samples (the last of each leg has fewer), folded by so many threads, wall and
    processor time (medians), the most memory of the process, and `faster`, how many times as fast as one thread.
    decisions: see `decisions`; past: see `lab.speed.past.run`.
    """
    work = (("day", samples_of(hours), BATCH), ("long", samples, A_SECOND), ("long", samples, BATCH))
    rows = [row for name, count, in_row in work for row in _folded(name, count, in_row, runs)]
    _say("a machine is distrusted")
    decided = list(decisions(hours))
    _say("maps of the past are read")
    return {
        "benchmark": "fold",
        "hours": hours,
        "samples": samples,
        "runs": runs,
        **machine(),
        "goals": GOALS,
        "rows": rows,
        "decisions": decided,
        "past": past.run(max(hours, LEAST_PAST_H), runs)["rows"],
    }


def _folded(name: str, samples: int, in_row: int, runs: int) -> Iterator[dict[str, str | float]]:
    """Fold one journal, with one thread and with two in turn."""
    count = -(-samples // in_row)
    with tempfile.TemporaryDirectory() as path:
        _say(f"a journal of {count * in_row} samples in rows of {in_row} is written")
        build(Path(path), count, tail_rows=count, in_row=in_row)
        figures: dict[int, list[Report]] = {1: [], 2: []}
        for number in range(runs):
            for each, taken in figures.items():
                _say(f"it is folded with {each} threads, run {number + 1} of {runs}")
                taken.append(in_child("lab.speed.fold", path, str(each)))
    one_s = statistics.median(report["wall_s"] for report in figures[1])
    for each, reports in figures.items():
        wall_s, cpu_s = (statistics.median(report[key] for report in reports) for key in ("wall_s", "cpu_s"))
        folded = reports[0]["samples"]
        yield {
            "journal": name,
            "samples": folded,
            "samples_in_row": in_row,
            "threads": each,
            "wall_s": round(wall_s, 2),
            "cpu_s": round(cpu_s, 2),
            "msamples_per_cpu_s": round(folded / cpu_s / 1e6, 3),
            "faster": round(one_s / wall_s, 2),
            "peak_mb": round(max(report["peak_mb"] for report in reports), 1),
        }


def fold_timed(folder: Path, count: int) -> Report:
    """Fold a whole journal with so many threads."""
    warm_up(CONFIG.fold)
    grid = Grid(SITE.cell_m, CONFIG.fold)
    with JournalLocation(folder).reader() as journal:
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        fold_history(grid, History(journal, JournalLocation(folder).archive), threads=count)
        wall_s, cpu_s = time.perf_counter() - start_s, time.process_time() - start_cpu_s
        sent = sum(watermark.seq for watermark in journal.watermarks().values())
    if (samples := grid.folded + grid.skipped) != sent:
        raise RuntimeError(f"{samples} of {sent} samples are in the grid: nothing was measured")
    return {"wall_s": wall_s, "cpu_s": cpu_s, "peak_mb": memory_mb("VmHWM"), "samples": samples}


def _say(what: str) -> None:
    print(f"fold: {what}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    print(json.dumps(fold_timed(Path(sys.argv[1]), int(sys.argv[2]))))
