"""Sources of a fold from the command line: files, folders, stores; their parts, site and decisions."""

from __future__ import annotations

import json
import socket
from argparse import Namespace
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mapserver.config import ServerConfig
from mapserver.ingest.decisions import GroundDecision, ground_decisions
from mapserver.ingest.map_info import lacking
from mapserver.ingest.store import ACCEPTED
from mapserver.journal import archived_decisions
from mapserver.journal.archive_file import ArchiveFile
from mapserver.journal.location import JOURNAL_FILE, JournalLocation
from mapserver.journal.places import FilePlace
from mapserver.journal.rows import SpoolKey, Watermark
from protocol.config import from_table
from protocol.errors import ConfigError, StoreError
from protocol.files import load_toml
from protocol.site.site_config import SiteConfig
from protocol.site.site_file import load_site
from sitegrid.refold.parts import SLICE_ROWS, Contents, FilePart, JournalPart, Part

SITE_FILE, CONFIG_FILE = "site.toml", "server.toml"  # in the new store


@dataclass(frozen=True)
class Source:
    """One named archive. stores: ids of its samples' stores, and of stores they replaced."""

    path: Path | FilePlace | JournalLocation
    parts: tuple[Part, ...]
    decisions: Sequence[GroundDecision]
    stores: tuple[str, ...] = ()
    site: SiteConfig | None = None
    watermarks: Mapping[SpoolKey, Watermark] = field(default_factory=dict)


def source(path: Path | FilePlace | JournalLocation) -> Source:
    """Describe a Parquet file, a folder of them, a store or a PostgreSQL journal, without reading samples."""
    if isinstance(path, JournalLocation):
        return _store(path)
    path = path.absolute() if isinstance(path, Path) else path
    if isinstance(path, Path) and JournalLocation(path).exists():
        return _store(JournalLocation(path))
    if not path.exists():
        raise ConfigError(path, "no such file or folder")
    files: list[Path | FilePlace] = [path]
    if path.is_dir():
        files = sorted(path.glob("*.parquet"), key=str)
    if not files:
        raise ConfigError(path, f"holds neither Parquet files nor a {JOURNAL_FILE}")
    return Source(path, tuple(map(FilePart, files)), archived_decisions.load(files[0].parent))


def _store(location: JournalLocation) -> Source:
    shortfall = None if location.is_shared else lacking(location)  # a shared journal's servers keep the proof
    if shortfall:
        advice = "restore a backup, or start a map server on it once: it keeps a note of that, and goes on"
        raise StoreError(location, f"{shortfall}; {advice}")
    with location.reader() as journal:
        last, archived = journal.last_row, journal.archived_row
        files = location.archive.cover(archived)
        slices = range(archived, last, SLICE_ROWS)
        host, cut = (
            "" if location.is_shared else socket.gethostname(),
            [(after, min(after + SLICE_ROWS, last)) for after in slices],
        )
        rest = (JournalPart(location, after, until, host) for after, until in cut)
        identity, accepted = journal.identity(), (event.body["store"] for event in journal.events(ACCEPTED))
        stores = (identity.id, *identity.descends, *accepted)
        parts: tuple[Part, ...] = (*map(FilePart, files), *rest)
        path, site = (location, None) if location.is_shared else (location.folder, _site_of(location.folder))
        return Source(path, parts, ground_decisions(journal), stores, site, journal.watermarks())


def _site_of(store: Path) -> SiteConfig | None:
    """A store's site: its own file, or the newest archive's header."""
    if (store / SITE_FILE).exists():
        return load_site(store / SITE_FILE)
    paths = JournalLocation(store).archive.paths()
    return ArchiveFile(paths[-1]).header.site if paths else None


def chosen_site(sources: Sequence[Source], contents: Sequence[Contents], arguments: Namespace) -> SiteConfig:
    """The common site of all parts, with the options' changes."""
    first = contents[0]
    given = load_site(arguments.site_file) if arguments.site_file else None
    known = [*(source.site for source in sources), *(each.origin.site for each in contents)]
    site = given or next((site for site in known if site), None)
    if not site:
        raise ConfigError(first.part, "does not say where its site is; give --site-file")
    if (site.name, site.frame) != (first.origin.name, first.origin.frame):
        problem = f"is site {site.name!r}, frame {site.frame}, the archives are of {first.origin.name!r}"
        raise ConfigError(arguments.site_file or SITE_FILE, f"{problem}, frame {first.origin.frame}")
    try:
        return replace(site, cell_m=arguments.cell or site.cell_m)
    except ValueError as error:
        raise ConfigError("--cell", str(error)) from None


def chosen_config(sources: Sequence[Source], arguments: Namespace) -> tuple[ServerConfig, str]:
    """Server options and their text: --config, or the first store with its own."""
    kept = (each.path / CONFIG_FILE for each in sources if each.watermarks and isinstance(each.path, Path))
    path = arguments.config or next((file for file in kept if file.exists()), None)
    if not path:
        return ServerConfig(), "# Every option has its default.\n"
    return from_table(ServerConfig, load_toml(path), str(path)), path.read_text(encoding="utf-8")


def joined_decisions(histories: Iterable[Sequence[GroundDecision]]) -> list[GroundDecision]:
    """Decisions of all sources by stamp, independent of source order.

    Decisions common to two histories, like a store's and its archive's, count once; repetitions within one history
    count (correct, undo, correct again). Each history keeps its order, even if the site's clock went back.
    """
    places: dict[tuple[GroundDecision, int], tuple[int, int]] = {}
    for history in histories:
        newest_ns, times = 0, Counter[GroundDecision]()
        for position, decision in enumerate(history):
            newest_ns = max(newest_ns, decision.stamp_ns)
            times[decision] += 1
            key = decision, times[decision]
            places[key] = max(places.get(key, (0, 0)), (newest_ns, position))
    ordered = sorted(places, key=lambda key: (places[key], json.dumps(key[0].body()), key[1]))
    return [decision for decision, _ in ordered]


def descent(sources: Sequence[Source], contents: Sequence[Contents]) -> Iterator[str]:
    """Unique ids of all ancestor stores."""
    own = {part: each.origin.stores for each in contents for part in [each.part]}
    named = (store for each in sources for store in (*each.stores, *(s for part in each.parts for s in own[part])))
    yield from dict.fromkeys(named)
