"""Intervals of cells, segments and routes share one error model."""

import math

import numpy as np
import pytest

from mapserver.error_model import line_variance, resistance_variance
from mapserver.evidence.fold_config import FoldConfig
from mapserver.evidence.grid import Grid
from mapserver.layers.cell_layers import ReadConfig, read
from mapserver.roads.loss import losses
from protocol.site.geometry import CellWindow
from tests.unit.mapserver.roads.drives import along, passes
from tests.unit.mapserver.roads.test_ledger import ledger_of


@pytest.mark.parametrize("c_rr", [0.01, 0.03, 0.2])
def test_a_cell_and_a_segment_on_which_all_passes_agree_are_as_sure(c_rr):
    rows = passes(along([(10, 10), (110, 10)]), 8, c_rr=c_rr)
    grid = Grid(1.0, FoldConfig())
    grid.fold(rows, "a")
    cells = read(grid.evidence(grid.blocks_in(CellWindow(-200, -200, 600, 400))), ["resistance_std"], ReadConfig())[
        "resistance_std"
    ]
    of_segments = losses(*ledger_of(rows), 0.02).c_std
    expected = math.sqrt(float(resistance_variance(np.array(c_rr))))
    assert np.nanmedian(cells) == pytest.approx(expected, rel=0.03)
    assert of_segments == pytest.approx(expected, rel=0.03)
    assert line_variance(c_rr) < expected**2
