"""Fold the samples of archives and stores again, with other parameters, into a new store.

The new store has its samples in an archive, a journal that continues after it, and a snapshot. It is made in `OUT.part`
and renamed when complete.
"""

from __future__ import annotations

import json
import sys
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from importlib.util import find_spec
from typing import Any

from mapserver.ingest.decisions import Decisions
from mapserver.journal.history import THREADS
from mapserver.journal.rows import Selection
from protocol.errors import ConfigError
from protocol.machine.readings import MAX_STAMP_NS
from protocol.site.site_config import SiteConfig, site_toml
from sitegrid.process.lifetime import raise_interrupts, say, tell
from sitegrid.process.progress import Display
from sitegrid.refold.engine import Cluster, Engine, Here
from sitegrid.refold.new_store import making
from sitegrid.refold.plan import Plan, plan
from sitegrid.refold.sources import (
    CONFIG_FILE,
    SITE_FILE,
    Source,
    chosen_config,
    chosen_site,
    descent,
    joined_decisions,
    source,
)
from sitegrid.refold.work import Fold, FoldTask, PartWork, code_digest, fold_parts, merge_tile, merged_state, tiles


def run(arguments: Namespace) -> int:
    """Fold once and print the outcome."""
    raise_interrupts()  # incomplete output is removed, or kept for a restart
    summary = fold(arguments)
    say(summary) if arguments.json else tell(*_lines(summary))
    return 0


def fold(arguments: Namespace) -> dict[str, Any]:
    """Fold once; returns the outcome."""
    selection = Selection(
        from_ns=arguments.from_ns or 0,
        to_ns=MAX_STAMP_NS if arguments.until_ns is None else arguments.until_ns - 1,
        without=frozenset(arguments.without),
    )
    if selection.to_ns < selection.from_ns:
        raise ConfigError("--until", "is not after --from, so no time is left between them")
    if arguments.out.exists() and (not arguments.out.is_dir() or any(arguments.out.iterdir())):
        raise ConfigError(arguments.out, "exists and is not empty; choose another --out")
    sources = [source(path) for path in arguments.archives]
    with _engine(arguments, sum(len(each.parts) for each in sources)) as engine:
        parts = [part for each in sources for part in each.parts]
        planned = plan(parts, selection, engine)
        site = chosen_site(sources, planned.contents, arguments)
        known = {name for each in planned.contents for name in each.origin.machines}
        known |= {machine for each in sources for machine, _ in each.watermarks}
        if unknown := sorted(selection.without - known):
            problem = f"{unknown[0]!r} is no machine of these archives; they are: {', '.join(sorted(known))}"
            raise ConfigError("--without", problem)
        if not planned.kept.total():
            raise ConfigError("sitegrid fold", f"no sample is left: {json.dumps(planned.excluded)} are excluded")
        return _build(arguments, sources, planned, site, engine)


def _engine(arguments: Namespace, parts: int) -> AbstractContextManager[Engine]:
    """Never more processes than parts."""
    jobs = min(arguments.jobs, parts)
    return Cluster(arguments.engine or "", jobs) if arguments.engine or jobs > 1 else nullcontext(Here(THREADS))


def _build(
    arguments: Namespace, sources: Sequence[Source], planned: Plan, site: SiteConfig, engine: Engine
) -> dict[str, Any]:
    """Make the store beside its place and move it there when complete."""
    config, text = chosen_config(sources, arguments)
    decisions = joined_decisions(each.decisions for each in sources)
    decided = Decisions()
    decided.add(decisions, len(decisions))
    reached = ((spool, mark.seq) for each in sources for spool, mark in each.watermarks.items())
    out = arguments.out.absolute()
    part, rows = out.with_name(f"{out.name}.part"), sum(each.rows for each in planned.contents)
    with making(part, site, tuple(descent(sources, planned.contents)), rows) as store:
        corrections, selection = decided.facts.corrections, planned.selection
        fold = Fold(store.work, store.id, site, config.fold, selection, corrections, code_digest())
        tasks = list(_tasks(fold, planned, engine))
        with _progress(arguments, tasks) as done:
            engine.each(fold_parts, tasks, done)
        evidence = [task.evidence for task in tasks]
        merged = list(tiles(fold, evidence)) if len(evidence) > 1 else []
        engine.each(merge_tile, merged)
        store.save_map(merged_state(evidence, [tile.path for tile in merged] or evidence), config, decided.facts)
        store.fill_journal(planned.watermarks(reached), decisions)
        store.take_samples((part, task.samples(part)) for task in tasks for part in task.parts)
        info = store.finish(out, {SITE_FILE: site_toml(site), CONFIG_FILE: text}, config)
    machines: Counter[str] = Counter()
    for (machine, _), samples in planned.kept.items():
        machines[machine] += samples
    return {
        "store": str(arguments.out),
        "id": info["store"],
        "descends": info["descends"],
        "archives": len(sources),
        "rows": info["journalled"],
        "samples": machines.total(),
        "excluded": planned.excluded,
        "too_unsure": info["samples_too_unsure"],
        "machines": dict(sorted(machines.items())),
        "cells": info["cells"],
        "cell_m": site.cell_m,
    }


def _tasks(fold: Fold, planned: Plan, engine: Engine) -> Iterator[FoldTask]:
    """Consecutive parts of about TASK_SAMPLES; one task for a single process."""
    row, samples = 1, 0
    parts: list[PartWork] = []
    for each, taken in zip(planned.contents, planned.taken, strict=True):
        if not each.rows:
            continue
        if parts and samples + each.samples > engine.task_samples:
            yield FoldTask(fold, tuple(parts), engine.threads)
            parts, samples = [], 0
        words = (each.first_ns, row, each.rows, each.samples, tuple(sorted(taken.items())))
        parts.append(PartWork(each.part, each.origin.identity, *words))
        row, samples = row + each.rows, samples + each.samples
    yield FoldTask(fold, tuple(parts), engine.threads)


@contextmanager
def _progress(arguments: Namespace, tasks: Sequence[FoldTask]) -> Iterator[Callable[[int], None]]:
    """Show progress on a terminal; yields a callback for finished task numbers."""
    if arguments.json or not sys.stderr.isatty() or not find_spec("rich"):
        yield lambda _: None
        return
    sizes = [sum(part.samples for part in task.parts) for task in tasks]
    folded, total = 0, sum(sizes)
    with Display("samples are folded", headless=False) as display:

        def done(number: int) -> None:
            nonlocal folded
            folded += sizes[number]
            display.show(folded, total, f"{folded / 1e6:.2f} of {total / 1e6:.2f} M samples")

        yield done


def _lines(summary: Mapping[str, Any]) -> list[str]:
    """The summary for people."""
    excluded, store = summary["excluded"], summary["store"]
    size = f"{summary['rows']} journal rows, {summary['cells']} cells of {summary['cell_m']:g} m"
    return [
        f"{store}: {summary['samples']} samples in {size}",
        *(f"  {machine}: {samples} samples" for machine, samples in summary["machines"].items()),
        f"  excluded: {excluded['machine']} of machines, {excluded['time']} by time, {excluded['twice']} duplicates",
        f"  too uncertain of their position to vote: {summary['too_unsure']}",
        f"sitegrid server --store {store} --site-file {store}/{SITE_FILE} --config {store}/{CONFIG_FILE}",
    ]
