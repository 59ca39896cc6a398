"""`sitegrid export`: the map as files for other programs."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from protocol.queries.request import parameters_of
from protocol.queries.requests import RegionQuery
from protocol.queries.roads import SegmentsQuery
from sitegrid.commands.fold import archive_place
from sitegrid.options.groups import add_network, add_site
from sitegrid.options.parameters import add_parameters
from sitegrid.options.values import OutputFile, names

HELP = "write the map, roads or samples into a file for QGIS, CAD, notebooks or people"
EXTRA = "export"
BESIDE = {"numba": "server", "prometheus_client": "server", "scipy": "server"}
FORMS = (".tif", ".gpkg", ".geojson", ".fgb", ".parquet", ".csv", ".dxf", ".tum", ".html")
OF_CELLS = ("as_of", "layers", "resolution")  # region parameters that are options here


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    forms = f"{', '.join(FORMS[:-1])} or {FORMS[-1]}"
    add("file", type=OutputFile(FORMS), metavar="FILE", help=f"file to write; its form: {forms}")
    what = "what it holds, comma-separated: cells, zones, segments, worklist, repairs, changes, tracks, samples, report"
    add("--what", type=names, help=f"{what} (default: that which FILE is named after, else that of its form)")
    add_network(parser)
    add_site(parser)
    place = "in place of a running site: a store, or archives as `sitegrid fold` takes them"
    add("--store", type=archive_place, metavar="PLACE", help=place)
    add("--site-file", type=Path, help="site file, if the store holds no site (site.toml)")
    add("--config", type=Path, help="the server's file with options (config/server.toml), for --store")
    sides = ("W", "S", "E", "N")
    bounds = "west, south, east, north in metres (default: the whole map)"
    add("--bounds", dest="asked_bounds", type=float, nargs=4, metavar=sides, help=bounds)
    add_parameters(parser, RegionQuery, [name for name in parameters_of(RegionQuery) if name not in OF_CELLS])
    add_parameters(parser, SegmentsQuery, [name for name in parameters_of(SegmentsQuery) if name != "machine"])


def run(arguments: Namespace) -> int:
    """Write one file and report its contents."""
    from sitegrid.export.command import run as export

    return export(arguments)
