"""Write one file: form by suffix, contents by options; everything is checked before writing."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import BinaryIO

from protocol.errors import ConfigError
from protocol.files import whole_file
from sitegrid.export.maps import opened, version_of
from sitegrid.export.wanted import Wanted, parse_wanted
from sitegrid.process.lifetime import raise_interrupts, return_large_blocks, say, tell
from sitegrid.times import iso

FEATURES = ("zones", "segments", "worklist", "repairs", "changes", "tracks")
OF_MACHINES = ("segments", "worklist", "repairs", "tracks", "samples")  # --machine applies to these
Write = Callable[[BinaryIO, Wanted, Sequence[str]], Mapping[str, int]]


@dataclass(frozen=True)
class FileForm:
    """A file form.

    writer: module of this package and function. holds: possible contents, at most `most` at once. usual: default
    contents; empty if it holds only one kind.
    """

    writer: tuple[str, str]
    holds: tuple[str, ...]
    usual: tuple[str, ...] = ()
    most: int = 1

    def write(self) -> Write:
        """The writing function; ModuleNotFoundError names what is not installed."""
        module, name = self.writer
        function: Write = getattr(import_module(f"sitegrid.export.{module}"), name)
        return function


TABLES = ("cells", "samples", *FEATURES)
FORMS = {
    ".tif": FileForm(("raster", "write_tif"), ("cells",), ("cells",)),
    ".gpkg": FileForm(("vectors", "write_gpkg"), FEATURES, FEATURES, len(FEATURES)),
    ".geojson": FileForm(("vectors", "write_geojson"), FEATURES),
    ".fgb": FileForm(("vectors", "write_fgb"), FEATURES),
    ".dxf": FileForm(("vectors", "write_dxf"), FEATURES, ("zones", "segments"), len(FEATURES)),
    ".parquet": FileForm(("tables", "write_parquet"), TABLES),
    ".csv": FileForm(("tables", "write_csv"), ("cells", "samples"), ("cells",)),
    ".tum": FileForm(("samples", "write_tum"), ("tracks",), ("tracks",)),
    ".html": FileForm(("report", "write_html"), ("report",), ("report",)),
}


def run(arguments: Namespace) -> int:
    """Write the file and report its contents."""
    raise_interrupts()  # incomplete files are removed
    return_large_blocks()
    path: Path = arguments.file
    form = FORMS[path.suffix.lower()]
    what = chosen(form, path, arguments)
    write = form.write()
    with opened(arguments) as site:
        wanted = parse_wanted(arguments, site)
        try:
            with whole_file(path) as file:
                counts = write(file, wanted, what)
        except OSError as error:  # a full disk's error names no file
            raise OSError(error.errno, error.strerror or str(error), str(path)) from None
    table = {"file": str(path), "site": wanted.info.site.name, "holds": counts, **version_of(wanted.info)}
    holds = ", ".join(f"{count} {name}" for name, count in counts.items())
    then = iso(wanted.roads.as_of_ns or wanted.info.stamp_ns)
    say(table) if arguments.json else tell(f"{path}: {holds} of {wanted.info.site.name}, as of {then}")
    return 0


def chosen(form: FileForm, path: Path, arguments: Namespace) -> Sequence[str]:
    """Contents of the file; ConfigError if impossible, or if an option had no effect."""
    named = (path.stem,) if path.stem in form.holds else form.usual
    if not arguments.store and not arguments.what:  # a running site only knows the map
        named = tuple(name for name in named if name != "tracks") or named
    what: Sequence[str] = arguments.what or named
    if not what or not set(what) <= set(form.holds) or len(set(what)) > form.most:
        every = ", ".join(form.holds)
        one_of = "one of" if form.most == 1 else "some of"
        example = form.holds[0] + path.suffix
        raise ConfigError(path, f"holds {one_of} {every}: name it with --what, or name the file {example}")
    for option, value, those in (
        ("--machine", arguments.asked_machine, OF_MACHINES),
        ("--layers", arguments.asked_layers, ("cells",)),
        ("--resolution", arguments.asked_resolution, ("cells", "report")),
    ):
        if value and (others := set(what) - set(those)):
            raise ConfigError(option, f"is of {', '.join(those)} alone, not of {min(others)}: see --what")
    return tuple(dict.fromkeys(what))
