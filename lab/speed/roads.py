"""Roads of a site of 40 km: made from the evidence, made again after a minute of work, and the worklist of a day."""

from __future__ import annotations

import statistics
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np
import zenoh

from lab.speed.measure import START_NS, Report, machine, medians, timed
from lab.speed.merge_work import batches
from lab.speed.processes import ask, at_work, processor_s, send, served, session
from mapserver.evidence.fold_config import FoldConfig, name_hash
from mapserver.evidence.grid import Grid
from mapserver.journal.facts import NO_FACTS
from mapserver.query.road_maps import RoadMap, Traffic
from mapserver.query.roads import worklist
from mapserver.roads.ledger import Ledgers
from mapserver.roads.network import network
from mapserver.roads.repairs import repairs
from mapserver.roads.segments import Segments, segments
from mapserver.roads.skeleton import Pages, Skeletons
from mapserver.roads.tally import HOUR_NS
from protocol.arrays import Table
from protocol.machine.samples import empty
from protocol.queries.answers import MapVersion
from protocol.queries.road_requests import WorklistQuery
from protocol.queries.roads import encode_worklist
from protocol.site.geometry import CellWindow
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.messages import SampleBatch

GOALS_MS = {"minute": 50.0, "worklist": 300.0}
ROADS, LENGTH_M, APART_M, STEP_M = 20, 1000.0, 50.0, 0.5  # as many along either axis: 40 km, 400 crossings
TRUCKS, MINUTE_M = 10, 480.0  # at 8 m/s
PASSES = 3  # of each road, an hour
TARGET, END_NS = 0.02, START_NS + 1000 * HOUR_NS
SITE = CellWindow(-100, -100, 1300, 1300)
INGEST_SITE, WINDOW_S, MOST_LOST_PCT = SiteConfig("bench", 48.0, 11.0), 10.0, 5.0


def run(hours: float, runs: int, seconds: float) -> Report:
    """Rows: what is made, and the median of its processor time in ms; counts of what there is.

    whole, minute: roads from nothing, and after a minute of ten machines; worklist: all else that one takes, up to its
    bytes. ingest: samples a second that a real server takes, with nobody asking and with a worklist asked for in
    windows of WINDOW_S, in turn, over so many seconds.
    """
    grid, traffic = Grid(1.0, FoldConfig()), Traffic()
    for hour in range(round(hours)):
        for road, turn in product(range(2 * ROADS), range(PASSES)):
            rows, name = _pass(road, hour, turn), f"truck-{(road + turn) % TRUCKS}"
            if hour < 2:
                grid.fold(rows, name)
            traffic.add(rows, np.full(len(rows), name_hash(name), np.uint64))
    skeletons = Skeletons(1.0)
    roads = _roads(skeletons, grid)
    traffic.tally.table()

    def minute() -> float:
        first = skeletons.made % (2 * ROADS)
        for truck in range(TRUCKS):
            grid.fold(_pass((first + truck) % (2 * ROADS), 3)[: round(MINUTE_M / STEP_M)], f"truck-{truck}")
        pages = _pages(grid)  # folded before it is timed: that is the fold's work
        return _timed(lambda: segments(network(skeletons.skeleton(pages))))

    variants: dict[str, Callable[[], float]] = {
        "whole": lambda: _timed(lambda: _roads(Skeletons(1.0), grid)),
        "minute": minute,
        "worklist": lambda: _timed(lambda: _worklist(roads, traffic)),
    }
    for variant in variants.values():
        variant()  # compiled
    found_ms = {name: 1e3 * seconds for name, seconds in medians(variants, runs).items()}
    counts = {
        "km": round(float(roads.length_m.sum()) / 1000, 2),
        "segments": len(roads.ids),
        "passes_looked_at": repairs(traffic.passes.passes(Ledgers(roads)))[1],
        "tally_rows": len(traffic.tally.table()),
        "tally_mb": round(traffic.tally.table().nbytes / 1e6, 1),
    }
    table = [{"made": name, "cpu_ms": round(ms, 1), "goal": GOALS_MS.get(name)} for name, ms in found_ms.items()]
    return {"benchmark": "roads", "hours": hours, **machine(), **counts, "rows": table, "ingest": _ingest(seconds)}


def _ingest(seconds: float) -> Report:
    """What a server takes from machines that send as fast as they are answered, and what asking costs of it."""
    counts = [0]
    with ExitStack() as opened:
        folder = opened.enter_context(tempfile.TemporaryDirectory())
        endpoint, server = opened.enter_context(served(Path(folder), INGEST_SITE))
        link, asker = (opened.enter_context(session(endpoint)) for _ in range(2))
        ended = opened.enter_context(at_work(partial(_send, link, counts)))
        rates: dict[bool, list[float]] = {False: [], True: []}
        cpu_us: dict[bool, list[float]] = {False: [], True: []}
        answer_s: list[float] = []
        for _ in range(max(1, round(seconds / (2 * WINDOW_S)))):
            for asks in rates:
                sent, began_s, cpu_s = counts[0], time.perf_counter(), processor_s(server)
                if asks:
                    answer_s.append(timed(lambda: ask(asker, keys.map_query(INGEST_SITE.name, "worklist"))))
                ended.wait(max(0.0, WINDOW_S - (time.perf_counter() - began_s)))
                rates[asks].append((counts[0] - sent) / (time.perf_counter() - began_s))
                cpu_us[asks].append(1e6 * (processor_s(server) - cpu_s) / max(counts[0] - sent, 1))
    ratios = [asked / alone for alone, asked in zip(rates[False], rates[True], strict=True)]
    return {
        "samples_per_s": round(statistics.median(rates[False])),
        "samples_per_s_asked": round(statistics.median(rates[True])),
        "cpu_us_per_sample": round(statistics.median(cpu_us[False]), 1),
        "cpu_us_per_sample_asked": round(statistics.median(cpu_us[True]), 1),
        "lost_pct": round(100 * (1 - statistics.median(ratios)), 1),
        "answer_s": round(statistics.median(answer_s), 2),
        "goal": MOST_LOST_PCT,
    }


def _send(link: zenoh.Session, counts: list[int], ended: threading.Event) -> None:
    """Send the batches of ten machines one after the other; counts[0]: samples taken."""
    sent: Counter[str] = Counter()
    for name, rows in batches():
        if ended.is_set():
            return
        send(link, INGEST_SITE, SampleBatch(name, 1, sent[name] + 1, rows, INGEST_SITE.frame))
        sent[name] += len(rows)
        counts[0] += len(rows)


def _pass(road: int, hour: int, turn: int = 0) -> Table:
    """Samples along one road, two metres from the last pass at most."""
    draw = np.random.default_rng([road, hour, turn])
    along = np.arange(0.0, LENGTH_M, STEP_M)
    beside = np.full(len(along), road % ROADS * APART_M + 25.0 + draw.normal(0.0, 0.4))
    rows = empty(len(along))
    rows["x_m"], rows["y_m"] = (along, beside) if road < ROADS else (beside, along)
    rows["heading_rad"] = 0.0 if road < ROADS else np.pi / 2
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.25
    rows["speed_mps"], rows["distance_m"], rows["mass_kg"] = 8.0, STEP_M, 40_000.0
    rows["c_rr"] = 0.02 + 0.02 * draw.random() + draw.normal(0.0, 0.003, len(along))
    rows["stamp_ns"] = START_NS + hour * HOUR_NS + turn * HOUR_NS // PASSES + np.arange(len(along)) * 62_500_000
    return rows


def _pages(grid: Grid) -> Pages:
    blocks = grid.blocks_in(SITE)
    return dict(zip(blocks, grid.pages(blocks), strict=True))


def _roads(skeletons: Skeletons, grid: Grid) -> Segments:
    return segments(network(skeletons.skeleton(_pages(grid))))


def _worklist(roads: Segments, traffic: Traffic) -> bytes:
    """All but the roads themselves."""

    def read(*_: object) -> RoadMap:
        ledgers = Ledgers(roads)
        changes = repairs(traffic.passes.passes(ledgers))[0]
        table = traffic.tally.table()
        return RoadMap(roads, ledgers, table, tuple(changes), {}, NO_FACTS, MapVersion("", 0, 0), END_NS)

    return encode_worklist(worklist(read, WorklistQuery(TARGET), INGEST_SITE.extent_m))


def _timed(work: Callable[[], object]) -> float:
    began_s = time.process_time()
    work()
    return time.process_time() - began_s
