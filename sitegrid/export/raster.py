"""Cells as a cloud-optimised GeoTIFF (rasterio): a band per layer, in the site's projection."""

from __future__ import annotations

from typing import BinaryIO

import numpy as np
import rasterio
from rasterio.io import MemoryFile
from rasterio.shutil import copy

from sitegrid.export.wanted import Wanted
from sitegrid.notebook import unit_of
from sitegrid.times import iso

CACHE_MB = 8  # GDAL's block cache; its default is 5 % of the host's memory
# GDAL's COG driver, lossless; overviews only contain values of cells.
COG = {"driver": "COG", "compress": "DEFLATE", "predictor": 3, "overview_resampling": "NEAREST"}


def write_tif(file: BinaryIO, wanted: Wanted, _: object) -> dict[str, int]:
    """Write all layers; NaN: unknown. GDAL writes to memory, because it hides errors of a full disk."""
    region = wanted.region()
    bounds, cell_m, version = region.bounds, region.cell_m, region.version
    layers = dict(region.layers)
    tags = {"site": wanted.info.site.name, "store": version.store, "row": version.row, "fact": version.fact}
    tags |= {"stamp": iso(region.stamp_ns) or ""}
    shape = {"width": len(region.x_m), "height": len(region.y_m), "count": len(layers)}
    place = {
        "crs": wanted.info.site.crs,
        "transform": rasterio.Affine(cell_m, 0.0, bounds.west_m, 0.0, -cell_m, bounds.north_m),
    }
    del region  # frees each layer after writing
    # Separate, compressed bands: the plain file is in memory too.
    plainly = {"driver": "GTiff", "tiled": True, "interleave": "band", "compress": "DEFLATE", "zlevel": 1}
    with rasterio.Env(GDAL_CACHEMAX=CACHE_MB), MemoryFile() as plain, MemoryFile() as whole:
        with plain.open(**plainly, **shape, **place, dtype="float32", nodata=np.nan) as bands:
            bands.update_tags(**tags)
            for band, name in enumerate(list(layers), 1):
                bands.write(layers.pop(name)[::-1], band)  # rows from the north
                bands.set_band_description(band, name)
                bands.set_band_unit(band, unit_of(name))
        copy(plain.name, whole.name, **COG)
        file.write(whole.getbuffer())
    return {"layers": shape["count"], "cells": shape["width"] * shape["height"]}
