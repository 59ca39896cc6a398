"""`sitegrid fold`: fold samples of archives and stores with other parameters into a new store."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from sitegrid.options.values import FOLDER, count, positive, stamp
from sitegrid.times import STAMP_HELP

HELP = "build a new store from archives, with other parameters"
EXTRA = "server"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    what = (
        "a Parquet file, a folder of them, or a store; also at any address that fsspec reaches (s3://...); "
        "or a journal in PostgreSQL (postgresql://...)"
    )
    add("archives", type=archive_place, nargs="+", metavar="ARCHIVE", help=what)
    add("--out", type=FOLDER, required=True, metavar="STORE", help="folder of the new store")
    add("--site-file", type=Path, help="site file, if the archives hold no site (site.toml)")
    add("--cell", type=positive, metavar="M", help="edge of a cell in metres (default: that of the site)")
    add("--config", type=Path, help="file with options (config/server.toml)")
    add("--without", action="append", default=[], metavar="MACHINE", help="exclude this machine; may be repeated")
    for name, what in (("from", "at or after T"), ("until", "before T")):
        summary = f"only samples with a stamp {what}; T: {STAMP_HELP}"
        add(f"--{name}", type=stamp, dest=f"{name}_ns", metavar="T", help=summary)
    add("--jobs", type=count, default=1, metavar="N", help="fold in N processes, by Dask (1: this one, on two threads)")
    add("--engine", metavar="ADDRESS", help="fold on a Dask cluster: dask://HOST:PORT of its scheduler")


def archive_place(word: str) -> Any:
    """Parse a path or address; its dependencies are for this command only."""
    from mapserver.journal.location import JournalLocation
    from mapserver.journal.places import place

    if word.startswith(("postgresql://", "postgres://")):
        return JournalLocation(Path(), word)
    return place(word)


def run(arguments: Namespace) -> int:
    """Fold once and print the outcome."""
    from sitegrid.refold.command import run as refold

    return refold(arguments)
