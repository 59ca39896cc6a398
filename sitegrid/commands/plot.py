"""`sitegrid plot`: the paper's plotter."""

from __future__ import annotations

from argparse import ArgumentParser, Namespace
from pathlib import Path

from protocol.queries.route_requests import WayQuery
from sitegrid.options.groups import add_network, add_site
from sitegrid.options.parameters import add_parameters
from sitegrid.options.values import PICTURE

HELP = "draw the map"
EXTRA = "server"


def add_options(parser: ArgumentParser) -> None:
    """Options of the command."""
    add = parser.add_argument
    add_network(parser)
    add_site(parser)
    add("--out", type=PICTURE, default="map.png", help="picture to write (default %(default)s)")
    sides = "west, south, east, north in metres (default: the whole map)"
    add("--bounds", type=float, nargs=4, metavar=("W", "S", "E", "N"), help=sides)
    add("--truth", type=Path, help="true map of a simulation (truth_map.npz): also draw the difference")
    add("--worklist", action="store_true", help="draw roads and the ten sections most worth grading instead")
    drawn = parser.add_mutually_exclusive_group()
    line = "draw a drive over these places, and what it costs along the way, instead"
    drawn.add_argument("--line", type=float, nargs="+", metavar="M", help=line)
    ends = ("X1", "Y1", "X2", "Y2")
    drawn.add_argument("--between", type=float, nargs=4, metavar=ends, help="the same of the line that costs least")
    add_parameters(parser, WayQuery, ("from", "to", "after", "wait"))


def run(arguments: Namespace) -> int:
    """Draw the map."""
    from sitegrid.pictures.draw import run as draw

    return draw(arguments)
