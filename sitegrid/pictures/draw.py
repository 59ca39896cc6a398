"""Pictures of the map as it is, with the tracks of the machines; once, or again and again."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import numpy as np

from mapserver.pictures.frame import Image
from mapserver.pictures.plotter import Track, draw_difference, draw_grade, draw_resistance, side_by_side, write_image
from protocol.errors import ConfigError, LinkError, QueryError
from protocol.queries.answers import Region
from protocol.site.geometry import Bounds
from sim.truth import TruthMap
from sitegrid.client import Client, connect
from sitegrid.pictures.tracks import TrackRecorder
from sitegrid.pictures.truth_layers import truth_layers
from sitegrid.process.lifetime import note, say, stop_flag

LAYERS = ("resistance", "grade_east", "grade_north")


def run(arguments: Namespace) -> int:
    """Draw the map; with --follow again and again until stopped."""
    stop = stop_flag()
    with connect(arguments.endpoint, arguments.site, keys=arguments.keys) as client:
        tracks = TrackRecorder(client.session, arguments.site)
        drawn = 0
        while not stop.is_set():
            drawn += _draw_if_possible(client, arguments, tracks.tracks())
            if not arguments.follow or drawn == arguments.pictures:
                break
            stop.wait(arguments.every)
        tracks.close()
    say({"picture": str(arguments.out), "drawn": drawn}) if arguments.json else note(f"{arguments.out}")
    return 0


def _draw_if_possible(client: Client, arguments: Namespace, tracks: list[Track]) -> int:
    """Draw one picture; with --follow, wait for a server that does not answer."""
    try:
        draw(client, arguments.out, arguments.bounds, tracks, arguments.truth)
    except (LinkError, QueryError) as error:
        if not arguments.follow:
            raise
        note(f"sitegrid plot: {error}; trying again")
        return 0
    return 1


def draw(
    client: Client, out: Path, bounds: list[float] | None, tracks: list[Track], truth: Path | None = None
) -> Region:
    """Ask for the map and write its picture; with a true map the difference beside it."""
    region = client.region(_bounds(client, bounds), LAYERS)
    row = draw_both(region, tracks)
    images = [side_by_side(row)]
    if truth:
        layers = truth_layers(TruthMap.load(truth), region)
        images = [
            side_by_side(row),
            side_by_side([draw_difference(region, layers, k) for k in ("resistance", "grade")]),
        ]
    write_image(out, images[0])
    for image in images[1:]:
        write_image(out.with_stem(f"{out.stem}-difference"), image)
    return region


def draw_both(region: Region, tracks: list[Track]) -> list[Image]:
    """Resistance and grade; the title of a map without any resistance says why."""
    has_torque = np.isfinite(region["resistance"]).any() or not np.isfinite(region["grade_east"]).any()
    title = "Rolling resistance" if has_torque else "Rolling resistance: unknown, no machine measures drive torque"
    return [draw_resistance(region, tracks, title), draw_grade(region, tracks)]


def _bounds(client: Client, given: list[float] | None) -> Bounds:
    """The rectangle to draw: as given, or everything that is known."""
    if given:
        try:
            return Bounds(*given)
        except ValueError as error:
            raise ConfigError("--bounds", str(error)) from None
    info = client.info()
    cells, cell_m = info.bounds, info.site.cell_m
    if cells is None:
        return Bounds(0, 0, 16 * cell_m, 16 * cell_m)
    west, south, east, north = (cell * cell_m for cell in cells)
    return Bounds(west, south, east, north)
