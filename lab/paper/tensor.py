"""The paper's map as one array: two layers of m x n cells with east, north, value."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lab.campaign.true_maps import region_of
from mapserver.pictures.plotter import NamedLayers
from protocol.arrays import Floats
from protocol.files import whole_file
from sim.truth import TruthMap


def tensor(layers: NamedLayers, truth: TruthMap) -> Floats:
    """A map (2, m, n, 3) over m cells east and n cells north: centre x, y [m], value.

    Layer 0: resistance [-]; layer 1: steepness [m/m], as the paper ignores direction. Cells never passed have value
    NaN.
    """
    region = region_of(truth, {})
    x_m, y_m = np.meshgrid(region.x_m, region.y_m, indexing="ij")
    steepness = np.hypot(layers["grade_east"], layers["grade_north"])
    values = (np.asarray(values, np.float64).T for values in (layers["resistance"], steepness))
    return np.stack([np.stack([x_m, y_m, of_layer], axis=-1) for of_layer in values])


def write_tensor(path: Path, layers: NamedLayers, truth: TruthMap) -> None:
    """Write it as .npy."""
    with whole_file(path) as out:
        np.save(out, tensor(layers, truth))
