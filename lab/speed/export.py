"""Time and memory to write 1 km2 of map as a GeoTIFF: by command, from a store."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from lab.speed.measure import Figures, in_child, in_turn, rows_of, timed
from lab.speed.site import SITE, forget_peak_mb
from mapserver.journal.history import release_memory
from protocol.arrays import Floats32
from protocol.files import whole_file
from protocol.queries.answers import Region
from protocol.site.geometry import Bounds
from protocol.site.site_config import site_toml
from sitegrid.export.maps import OpenMap, opened
from sitegrid.export.raster import write_tif
from sitegrid.export.wanted import parse_wanted
from sitegrid.process.lifetime import return_large_blocks
from sitegrid.proof.figures import Row
from tests.memory import memory_mb
from tests.site_work import BATCH, HOURS, samples_of, write_store

OPTIONS = {"hours": HOURS, "runs": 3}
GOALS = {("command", "wall_s"): "<= 3", ("map", "wall_s"): "<= 3", ("map", "times_layers"): "<= 1.5"}
LAYERS = "resistance,resistance_std,confidence,grade_east,grade_north,grade,visits,age_s"
BOUNDS = ("0", "0", "1000", "1000")
MB = 1e6


def run(hours: float, runs: int) -> Iterator[Row]:
    """command: on a store of `hours` of work, start included. map: after its layers are read.

    times_layers: extra peak memory, layers included, over the layers' size.
    """
    with tempfile.TemporaryDirectory() as path:
        store, site = Path(path) / "store", Path(path) / "site.toml"
        site.write_text(site_toml(SITE))
        store.mkdir()
        write_store(store, SITE, samples_of(hours) // BATCH, tail_rows=0)
        words = [str(Path(path) / "map.tif"), "--store", str(store), "--site-file", str(site), "--layers", LAYERS]
        command = [sys.executable, "-m", "sitegrid", "export", *words, "--bounds", *BOUNDS]
        variants = {
            "command": lambda: _spent(command),
            "map": lambda: in_child("lab.speed.export", path),
        }
        for case, figures in in_turn(variants, runs).items():
            yield from rows_of(case, figures)


def _spent(command: list[str]) -> Figures:
    """Wall time of a command, and its CPU time."""
    before = os.times()
    took = timed(lambda: subprocess.run(command, check=True, capture_output=True))  # noqa: S603
    after = os.times()
    spent_s = after.children_user + after.children_system - before.children_user - before.children_system
    return took | {"cpu_s": spent_s}


def of_map(folder: Path) -> Figures:
    """Cost of writing beyond reading, libraries loaded."""
    return_large_blocks()
    keys = {"asked_as_of": None, "asked_machine": None, "asked_resolution": None, "asked_layers": LAYERS}
    place = {"store": folder / "store", "site_file": folder / "site.toml", "config": None}
    with opened(Namespace(**place)) as site:
        wanted = parse_wanted(Namespace(**keys, asked_bounds=[*map(float, BOUNDS)]), site)
        region = wanted.region()
        copied = replace(wanted, map=OpenMap(lambda _: replace(region, layers=_copies(region))))
        corner = replace(wanted, cells=replace(wanted.cells, area=Bounds(0.0, 0.0, 300.0, 300.0)))
        write_tif(io.BytesIO(), corner, ())  # loads the libraries
        release_memory()
        rest_mb = forget_peak_mb(os.getpid())
        with whole_file(folder / "map.tif") as file:
            took = timed(lambda: write_tif(file, copied, ()))
    layers_mb = sum(values.nbytes for values in region.layers.values()) / MB
    above_mb = memory_mb("VmHWM") - rest_mb
    figures = {"layers_mb": layers_mb, "above_mb": above_mb, "times_layers": above_mb / layers_mb}
    return {**took, **figures, "file_mb": (folder / "map.tif").stat().st_size / MB}


def _copies(region: Region) -> dict[str, Floats32]:
    return {name: values.copy() for name, values in region.layers.items()}


if __name__ == "__main__":
    print(json.dumps(of_map(Path(sys.argv[1]))))
