"""The exported map: of a running site, a store, or archives; all answer the same queries."""

from __future__ import annotations

import time
from argparse import Namespace
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from protocol.errors import ConfigError
from protocol.queries.origin import SERVER, Origin
from protocol.queries.request import MapQuery
from sitegrid.client import connect
from sitegrid.follower_choice import Answered
from sitegrid.whole_answers import whole_answer

if TYPE_CHECKING:
    from mapserver.journal.rows import JournalRows, Selection
    from mapserver.query.answering import Answers

SITE_FILE, CONFIG_FILE = "--site-file", "--config"


@dataclass(frozen=True)
class OpenMap:
    """ask: complete answer to a query. rows: journal rows that may hold samples; None if only the map is known."""

    ask: Callable[[MapQuery[Any]], Any]
    rows: Callable[[Selection], Iterator[JournalRows]] | None = None


@contextmanager
def opened(arguments: Namespace) -> Iterator[OpenMap]:
    """Open the map named by the options."""
    if arguments.store:
        with ExitStack() as stack:
            yield _of_store(_folder(arguments, stack), arguments)
        return
    for option in (SITE_FILE, CONFIG_FILE):
        if getattr(arguments, option.strip("-").replace("-", "_")):
            raise ConfigError(option, "is of a store: give --store too")
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        yield OpenMap(client.ask)


def _folder(arguments: Namespace, stack: ExitStack) -> Path:
    """The named store, or a temporary one folded from archives."""
    from mapserver.journal.location import JournalLocation
    from sitegrid.refold.command import fold

    place = arguments.store
    if isinstance(place, Path) and JournalLocation(place).exists():
        return place
    store = Path(stack.enter_context(TemporaryDirectory(prefix="sitegrid-export-"))) / "store"
    asked = {"site_file": arguments.site_file, "config": arguments.config, "json": arguments.json}
    every: dict[str, Any] = {"cell": None, "from_ns": None, "until_ns": None, "without": [], "jobs": 1, "engine": None}
    fold(Namespace(archives=[place], out=store, **asked, **every))
    return store


def _of_store(folder: Path, arguments: Namespace) -> OpenMap:
    from mapserver.follower.follower import FollowerSource
    from mapserver.ingest.following import Following
    from mapserver.journal.location import JournalLocation
    from mapserver.query.answering import Answers
    from protocol.site.site_file import load_site
    from sitegrid.refold.sources import chosen_config, source

    known = source(folder)
    site = load_site(arguments.site_file) if arguments.site_file else known.site
    if not site:
        raise ConfigError(folder, f"does not say where its site is; give {SITE_FILE}")
    config, _ = chosen_config([known], arguments)
    location = JournalLocation(folder)
    following = Following(location, site, config)
    following.read_once()

    def rows(selection: Selection) -> Iterator[JournalRows]:
        with location.reader() as reader:
            yield from following.past.rows(reader, selection)

    answers = Answers(FollowerSource("export", following, time.time_ns))
    return OpenMap(partial(whole_answer, ask=partial(_answered, answers)), rows)


def _answered(answers: Answers, query: MapQuery[Any], _: Origin | None) -> Answered:
    return Answered(answers.answer(query), SERVER)


def version_of(info: Any) -> Mapping[str, Any]:
    """A file's map version, named as in answers."""
    return {"store": info.store, "merged": info.merged, "fact": info.fact}
