"""CPU time of a working map server per second of site time, by task.

Ten machines send a batch per second to the server's own objects: writer, audit, change search, snapshots. Only time is
simulated: a second passes when the previous one's work is done. Rare work (judging, snapshots) is measured once and
divided by its interval.
"""

from __future__ import annotations

import queue
import statistics
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

from lab.speed.measure import rows_of
from lab.speed.site import SITE
from mapserver.calibration.correction import UNCORRECTED
from mapserver.config import ServerConfig
from mapserver.evidence.grid import warm_up
from mapserver.ingest.backlog import GROUP_BATCHES
from mapserver.ingest.store import Incoming, Store
from mapserver.ingest.writer import Writer
from mapserver.journal.location import JournalLocation
from mapserver.trust.auditor import Auditor
from mapserver.upkeep.jobs import REST_TURNS, Audit, ChangeSearch
from protocol.wire.codec import encode_batch
from protocol.wire.messages import Ack, Refused, SampleBatch
from sitegrid.proof.figures import Row
from tests.site_work import BATCH, START_NS, Batches, batches, samples_of, seconds_of

OPTIONS = {"hours": 2.0, "seconds": 120.0}
FIGURE = "cpu_ms_per_s"
GOALS = {("look", FIGURE): "<= 10", ("sum", FIGURE): "<= 60"}
CONFIG = ServerConfig()
ANSWERED_S = 60.0


def run(hours: float, seconds: float) -> Iterator[Row]:
    """After `hours` of work, over `seconds` of site time.

    Cases are threads: writer (decode, commit, reply); fold, on the same thread, at each read; look: change search, with
    its share of the writer; audit (follow the journal, judge); snapshot, both threads; sum.
    """
    warm_up(CONFIG.fold)
    with tempfile.TemporaryDirectory() as folder:
        ms = _measured(Path(folder), hours, max(1, round(seconds)))
    for name, value in (*ms.items(), ("sum", sum(ms.values()))):
        yield from rows_of(name, {FIGURE: value})


def _measured(folder: Path, hours: float, seconds: int) -> dict[str, float]:
    # no automatic snapshot
    config = replace(CONFIG, store=replace(CONFIG.store, snapshot_s=1e6, archive_after_h=0.0))
    writer = Writer(Store(JournalLocation(folder), SITE, config, lambda: START_NS))
    reader = JournalLocation(folder).reader()
    try:
        link, work = Link(writer), batches()
        before = list(islice(work, samples_of(hours) // BATCH))
        link.send(before)
        audit = Audit(writer, reader, lambda *_: None, lambda: (UNCORRECTED, {}), threading.Event())
        search = ChangeSearch(writer, reader, lambda _: None, threading.Event())
        audit.run()
        for _ in range(REST_TURNS + 1):  # all blocks of a start
            search.run()
        ms = _each_second(link, audit, search, islice(seconds_of(work), seconds))
        ms["audit"] += _own_ms(_judging(before)) / CONFIG.trust.judge_s
        ms["snapshot"] = link.cpu_ms(lambda: _snapshot(writer), own=True) / CONFIG.store.snapshot_s
        return ms
    finally:
        reader.close()
        writer.close()


class Link:
    """A writer's input and output, and its thread's CPU time."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._sent: Counter[str] = Counter()

    def send(self, work: Batches) -> None:
        """Send batches in groups, awaiting each group's replies."""
        for first in range(0, len(work), GROUP_BATCHES):
            answers: queue.Queue[Ack | Refused] = queue.Queue()
            for name, rows in work[first : first + GROUP_BATCHES]:
                batch = SampleBatch(name, 1, self._sent[name] + 1, rows, SITE.frame)
                self._sent[name] += len(rows)
                self._writer.submit(Incoming(name, encode_batch(batch)), answers.put)
            for _ in work[first : first + GROUP_BATCHES]:
                if not isinstance(answer := answers.get(timeout=ANSWERED_S), Ack):
                    raise RuntimeError(f"the server refused a batch: {answer}")

    def fold(self) -> None:
        """Fold pending samples."""
        self._writer.run(lambda store: store.grid.folded)

    def cpu_ms(self, work: Callable[[], object], *, own: bool = False) -> float:
        """CPU milliseconds of the writer's thread during `work`; with `own` plus this thread's."""
        before_s = self._writer.run(lambda _: time.thread_time())
        own_ms = _own_ms(work)
        return (self._writer.run(lambda _: time.thread_time()) - before_s) * 1e3 + own * own_ms


def _each_second(link: Link, audit: Audit, search: ChangeSearch, seconds: Iterator[Batches]) -> dict[str, float]:
    """Means per second; for audit the median, which ignores the judging turn."""
    ms: dict[str, list[float]] = {"writer": [], "fold": [], "look": [], "audit": []}
    for second in seconds:
        ms["writer"].append(link.cpu_ms(lambda: link.send(second)))  # noqa: B023 # called at once
        ms["fold"].append(link.cpu_ms(link.fold))
        ms["look"].append(link.cpu_ms(search.run, own=True))
        ms["audit"].append(link.cpu_ms(audit.run, own=True))
    means = {name: statistics.fmean(figures) for name, figures in ms.items()}
    return means | {"audit": statistics.median(ms["audit"])}


def _judging(work: Batches) -> Callable[[], object]:
    auditor = Auditor(SITE.cell_m, CONFIG.fold)
    for name, rows in work:
        auditor.add(name, rows)
    return auditor.verdicts


def _snapshot(writer: Writer) -> None:
    write = writer.run(lambda store: store.snapshot())
    if write is None:
        raise RuntimeError("there is nothing new for a snapshot: nothing was measured")
    write()


def _own_ms(work: Callable[[], object]) -> float:
    start_s = time.thread_time()
    work()
    return (time.thread_time() - start_s) * 1e3
