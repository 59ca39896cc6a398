"""Maps of the past and the history of a point, from a store with a day of work and its checkpoints; what these take."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from lab.speed.measure import START_NS, Report, machine
from lab.speed.merge_restart import CONFIG, SITE, build
from lab.speed.merge_work import A_SECOND, samples_of
from mapserver.journal.facts import NO_FACTS
from mapserver.journal.journal import JournalReader
from mapserver.journal.location import JournalLocation
from mapserver.journal.rows import Admission
from mapserver.past.cell_history import cell_history
from mapserver.past.making import make
from mapserver.past.past import Past
from mapserver.past.plan import GRACE_NS, HOUR_NS, due
from protocol.machine.samples import empty
from protocol.site.geometry import CellWindow
from protocol.wire.messages import SampleBatch

POINT_M, AROUND_CELLS = 250.0, 80  # a crossing; the cells that a point is read from, as changes need surroundings
HISTORY_ROWS, HISTORY_SPAN_NS = 100_000, 300 * 10**9
GOALS_MS = {
    "point, last day": 30,
    "whole map, last day": 1000,
    "whole map, last month": 3000,
    "history of a point": 1000,
}
MB = 1e6
Took = tuple[float, float]  # seconds on the clock, and of the processor


def run(hours: float, runs: int) -> Report:
    """Work so many hours, make the checkpoints, ask for the past.

    Rows: what is asked, medians and the greatest. Times of the last day are any; for those of the last month there is
    no checkpoint but the first, as if it were that of the day before, and they are spread over the day: the greatest is
    for its end. checkpoints: how many, the largest one's size, processor time of the median one, which is an hour's.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        build(path, samples_of(hours) // A_SECOND, tail_rows=0, in_row=A_SECOND)
        past = Past.of_store(path, SITE.cell_m, CONFIG.fold)
        with JournalLocation(path).reader() as reader:
            checkpoints = made(past, reader, START_NS + round(hours * HOUR_NS))
            rows = list(_asked(past, reader, START_NS + round(hours * HOUR_NS), runs))
    rows.append(_row("history of a point", history(runs)))
    return {"benchmark": "past", "hours": hours, "runs": runs, **machine(), "checkpoints": checkpoints, "rows": rows}


def made(past: Past, reader: JournalReader, now_ns: int) -> Report:
    """Make all checkpoints of a store as of a time."""
    closed, seconds, steps = list[int](), list[float](), list[float]()
    while (closed_ns := due(now_ns + GRACE_NS, closed, [], lambda at: past.next_stamp(reader, at))) is not None:
        began_s = last_s = time.process_time()
        for _ in make(past, reader, closed_ns, NO_FACTS):
            steps.append(time.process_time() - last_s)
            last_s = time.process_time()
        seconds.append(time.process_time() - began_s)
        closed.append(closed_ns)
    sizes = [past.checkpoints.path(closed_ns).stat().st_size for closed_ns in closed]
    return {
        "count": len(closed),
        "largest_mb": round(max(sizes) / MB, 1),
        "cpu_s_median": round(statistics.median(seconds), 3),
        "step_ms_max": round(max(steps) * 1e3, 1),
    }


def _asked(past: Past, reader: JournalReader, now_ns: int, runs: int) -> Iterator[Report]:
    """Whole maps and points within the last day, then with the first checkpoint alone."""
    times = iter(np.random.default_rng(0).integers(START_NS + HOUR_NS, now_ns, 100 * runs).tolist())
    window = CellWindow(int(POINT_M) - AROUND_CELLS // 2, int(POINT_M) - AROUND_CELLS // 2, AROUND_CELLS, AROUND_CELLS)
    past.grid_as_of(reader, now_ns, window).state()  # kernels are loaded
    yield _row(
        "point, last day", [_took_s(lambda: past.grid_as_of(reader, next(times), window)) for _ in range(9 * runs)]
    )
    yield _row("whole map, last day", [_took_s(lambda: past.grid_as_of(reader, next(times))) for _ in range(runs)])
    for entry in past.checkpoints.entries(lambda _: {}, 0)[1:]:
        entry.path.unlink()
    later = iter(np.linspace(START_NS + HOUR_NS, now_ns, runs + 1, dtype=np.int64)[1:].tolist())
    yield _row("whole map, last month", [_took_s(lambda: past.grid_as_of(reader, next(later))) for _ in range(runs)])


def history(runs: int) -> list[Took]:
    """What the history of a point takes that all of HISTORY_ROWS journal rows are about, in each of so many runs."""
    draw = np.random.default_rng(1)
    with tempfile.TemporaryDirectory() as folder:
        journal = JournalLocation(Path(folder)).open(SITE.name, SITE.frame)
        journal.begin()
        for number in range(HISTORY_ROWS):
            rows = empty(A_SECOND)
            rows["stamp_ns"] = START_NS + number * 10**9 + np.arange(A_SECOND) * 10**8
            rows["x_m"], rows["y_m"] = POINT_M + draw.normal(0.0, 3.0, (2, A_SECOND))
            rows["cov_xx_m2"] = rows["cov_yy_m2"] = 1.2**2
            rows["distance_m"], rows["c_rr"], rows["grade_e"], rows["grade_n"] = 0.5, 0.04, 0.0, 0.0
            batch = SampleBatch("loader-1", 1, 1 + number * A_SECOND, rows, SITE.frame)
            journal.append(Admission(batch, trimmed=0, lost=0), START_NS)
        journal.commit()
        past, cell = Past.of_store(Path(folder), SITE.cell_m, CONFIG.fold), (int(POINT_M), int(POINT_M))
        with JournalLocation(Path(folder)).reader() as reader:
            seconds = [_took_s(lambda: cell_history(past, reader, cell, HISTORY_SPAN_NS)) for _ in range(runs)]
        journal.close()
    return seconds


def _took_s(work: Callable[[], object]) -> Took:
    began_s, cpu_s = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - began_s, time.process_time() - cpu_s


def _row(what: str, took: list[Took]) -> Report:
    """A row of what was asked, in milliseconds: until the answer was there, and of the processor, all threads."""
    seconds, cpu = zip(*took, strict=True)
    figures = {"ms_median": statistics.median(seconds), "cpu_ms_median": statistics.median(cpu), "cpu_ms_max": max(cpu)}
    return {
        "asked": what,
        **{name: round(1e3 * value, 1) for name, value in figures.items()},
        "goal_ms": GOALS_MS[what],
    }
