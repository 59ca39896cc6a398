"""The samples of archives and stores, folded again with other parameters into a new store."""

from __future__ import annotations

import json
import shutil
import sys
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from itertools import takewhile
from pathlib import Path
from typing import Any

from mapserver.config import ServerConfig
from mapserver.fleet.decisions import CalibrationDecision
from mapserver.ingest.decisions import calibrations, plain
from mapserver.ingest.losses import lacking
from mapserver.ingest.store import ACCEPTED, Store
from mapserver.journal import archived_decisions
from mapserver.journal.archive_file import ArchiveFile
from mapserver.journal.copier import Copier, merged
from mapserver.journal.history import History, history_rows
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.rows import JournalRow, Selection, SpoolKey, Watermark
from protocol.config import from_table
from protocol.errors import ConfigError, StoreError
from protocol.files import load_toml
from protocol.machine.readings import MAX_STAMP_NS
from protocol.site.site_config import SiteConfig, site_toml
from protocol.site.site_file import load_site
from sitegrid.process.lifetime import raise_interrupts, say, tell
from sitegrid.process.progress import Display

SITE_FILE, CONFIG_FILE = "site.toml", "server.toml"  # in the new store
COMMIT_ROWS = 500


@dataclass(frozen=True)
class SampleSource:
    """Rows of a file or a store. site: where it is known; first_ns: when its first row was received.

    stores: ids of the stores whose samples these are, or whose place that store took. decisions: about calibration.
    """

    path: Path
    name: str
    frame: str
    site: SiteConfig | None
    machines: frozenset[str]
    samples: int
    first_ns: int
    rows: Iterator[JournalRow]
    stores: tuple[str, ...]
    watermarks: Mapping[SpoolKey, Watermark] = field(default_factory=dict)
    decisions: Sequence[CalibrationDecision] = ()


def run(arguments: Namespace) -> int:
    """Fold once and print what became of the samples."""
    raise_interrupts()  # a store that is not complete is removed
    selection = Selection(
        from_ns=arguments.from_ns or 0,
        to_ns=MAX_STAMP_NS if arguments.until_ns is None else arguments.until_ns - 1,
        without=frozenset(arguments.without),
    )
    if selection.to_ns < selection.from_ns:
        raise ConfigError("--until", "is not after --from, so no time is left between them")
    if arguments.out.exists() and (not arguments.out.is_dir() or any(arguments.out.iterdir())):
        raise ConfigError(arguments.out, "exists and is not empty; choose another --out")
    with ExitStack() as opened:
        sources = [source for path in arguments.archives for source in _sources(path, selection, opened)]
        site = _site(sources, arguments)
        known = {name for source in sources for name in source.machines}
        if unknown := sorted(selection.without - known):
            problem = f"{unknown[0]!r} is no machine of these archives; they are: {', '.join(sorted(known))}"
            raise ConfigError("--without", problem)
        summary = _build(arguments, sources, site, selection)
    say(summary) if arguments.json else tell(*_lines(summary))
    return 0


def _build(arguments: Namespace, sources: list[SampleSource], site: SiteConfig, selection: Selection) -> dict[str, Any]:
    """Make the store beside its place, and put it there when it is complete."""
    config, text = _config(arguments)
    part = arguments.out.with_name(f"{arguments.out.name}.part")
    if part.exists():
        raise ConfigError(part, "is left from a fold that was killed; remove it")
    part.mkdir(parents=True)
    try:
        copier = _copy(part, sources, site, selection, headless=arguments.json)
        (part / SITE_FILE).write_text(site_toml(site), encoding="utf-8")
        (part / CONFIG_FILE).write_text(text, encoding="utf-8")
        with closing(Store(JournalLocation(part), site, config, time.time_ns)) as store:
            store.save_snapshot()  # to start from
            info = store.info()
        part.replace(arguments.out)
    except BaseException:
        shutil.rmtree(part)
        raise
    machines: Counter[str] = Counter()
    for (machine, _), samples in copier.kept.items():
        machines[machine] += samples
    return {
        "store": str(arguments.out),
        "id": info["store"],
        "descends": info["descends"],
        "archives": len(sources),
        "rows": info["journalled"],
        "samples": machines.total(),
        "excluded": dict(copier.excluded),
        "too_unsure": info["samples_too_unsure"],
        "machines": dict(sorted(machines.items())),
        "cells": info["cells"],
        "cell_m": site.cell_m,
    }


def _sources(path: Path, selection: Selection, opened: ExitStack) -> Iterator[SampleSource]:
    """What a Parquet file, a folder of them or a store holds; only samples of the selected time are read."""
    in_time = Selection(from_ns=selection.from_ns, to_ns=selection.to_ns)
    if JournalLocation(path).exists():
        yield _store(path, in_time, opened)
        return
    if not path.exists():
        raise ConfigError(path, "no such file or folder")
    files = sorted(path.glob("*.parquet")) if path.is_dir() else [path]
    if not files:
        raise ConfigError(path, f"holds neither Parquet files nor a {JOURNAL_FILE}")
    decisions = archived_decisions.load(files[0].parent)
    for file in map(ArchiveFile, files):
        header, site, rows = file.header, file.header.site, file.read(selection=in_time)
        contents = (frozenset(header.machines), file.samples, file.first_received_ns, rows, (header.store,))
        yield SampleSource(file.path, site.name, header.frame, site, *contents, decisions=decisions)


def _store(path: Path, selection: Selection, opened: ExitStack) -> SampleSource:
    location = JournalLocation(path)
    if shortfall := lacking(location):
        advice = "restore a backup, or start a map server on it once: it keeps a note of that, and goes on"
        raise StoreError(location, f"{shortfall}; {advice}")
    journal = opened.enter_context(location.reader())
    history, watermarks = History(journal, location.archive), journal.watermarks()
    first = next(history_rows(history), None)
    samples = sum(watermark.seq - watermark.lost for watermark in watermarks.values())
    machines = frozenset(machine for machine, _ in watermarks)
    first_ns = first.received_ns if first else 0
    rows = history_rows(history, selection=selection)
    site = _site_of(path)
    identity, accepted = journal.identity(), (event.body["store"] for event in journal.events(ACCEPTED))
    stores = (identity.id, *identity.descends, *accepted)
    contents = (machines, samples, first_ns, rows, stores, watermarks, calibrations(journal))
    return SampleSource(path, journal.site, journal.frame, site, *contents)


def _site_of(store: Path) -> SiteConfig | None:
    """The site as a store knows it: a file of its own, or the header of its newest archive."""
    if (store / SITE_FILE).exists():
        return load_site(store / SITE_FILE)
    paths = JournalLocation(store).archive.paths()
    return ArchiveFile(paths[-1]).header.site if paths else None


def _site(sources: list[SampleSource], arguments: Namespace) -> SiteConfig:
    """The one site of all sources, with what the options change."""
    for source in sources[1:]:
        if (source.name, source.frame) != (sources[0].name, sources[0].frame):
            problem = f"is of site {source.name!r}, frame {source.frame}"
            problem += f", but {sources[0].path} of {sources[0].name!r}, {sources[0].frame}; fold them apart"
            raise ConfigError(source.path, problem)
    given = load_site(arguments.site_file) if arguments.site_file else None
    site = given or next((source.site for source in sources if source.site), None)
    if not site:
        raise ConfigError(sources[0].path, "does not say where its site is; give --site-file")
    if (site.name, site.frame) != (sources[0].name, sources[0].frame):
        problem = f"is site {site.name!r}, frame {site.frame}, the archives are of {sources[0].name!r}"
        raise ConfigError(arguments.site_file or SITE_FILE, f"{problem}, frame {sources[0].frame}")
    try:
        return replace(site, cell_m=arguments.cell or site.cell_m)
    except ValueError as error:
        raise ConfigError("--cell", str(error)) from None


def _config(arguments: Namespace) -> tuple[ServerConfig, str]:
    """The server's options and their text: from --config, else from the first store that has its own."""
    kept = (path / CONFIG_FILE for path in arguments.archives if JournalLocation(path).exists())
    path = arguments.config or next((file for file in kept if file.exists()), None)
    if not path:
        return ServerConfig(), "# Every option has its default.\n"
    return from_table(ServerConfig, load_toml(path), str(path)), path.read_text(encoding="utf-8")


def _copy(part: Path, sources: list[SampleSource], site: SiteConfig, selection: Selection, *, headless: bool) -> Copier:
    """Write the journal of the new store: samples, and what was decided about their corrections."""
    stores = dict.fromkeys(store for source in sources for store in source.stores)
    journal = JournalLocation(part).open(site.name, site.frame, stores)
    copier = Copier(journal, site.frame, selection)
    total, done = sum(source.samples for source in sources), 0
    sources = sorted(sources, key=lambda source: (source.first_ns, sorted(source.machines), source.path))
    origins = [(str(source.path), source.first_ns, source.rows) for source in sources]
    hidden = headless or not sys.stderr.isatty() or not find_spec("rich")
    with closing(journal), ExitStack() as ending:
        ending.callback(journal.rollback)  # after an error; a journal is not closed inside of a transaction
        display = None if hidden else ending.enter_context(Display("samples are copied", headless=False))
        journal.begin()
        for number, (origin, row) in enumerate(merged(origins)):
            copier.add(origin, row)
            done += len(row.rows)
            if number % COMMIT_ROWS == COMMIT_ROWS - 1:
                journal.commit()
                journal.begin()
                if display:
                    display.show(done, total, f"{done / 1e6:.2f} of {total / 1e6:.2f} M samples")
        copier.excluded["time"] += max(0, total - done)  # whole batches and files that were passed over
        copier.finish({spool: watermark.seq for source in sources for spool, watermark in source.watermarks.items()})
        journal.commit()
        journal.append_events(map(plain, _decisions(source.decisions for source in sources)))
    if not copier.kept.total():
        raise ConfigError("sitegrid fold", f"no sample is left: {json.dumps(copier.excluded)} are excluded")
    return copier


def _decisions(histories: Iterable[Sequence[CalibrationDecision]]) -> list[CalibrationDecision]:
    """Those of all sources, each history once; of those that begin alike, as of a store and its archive, what goes on.

    A decision that was made twice counts twice: who corrects, takes that back, and corrects again, has corrected.
    """
    out: list[CalibrationDecision] = []
    taken: list[Sequence[CalibrationDecision]] = []
    for history in histories:
        if history not in taken:
            same = takewhile(lambda pair: pair[0] == pair[1], zip(out, history, strict=False))
            out += history[sum(1 for _ in same) :]
            taken.append(history)
    return out


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
