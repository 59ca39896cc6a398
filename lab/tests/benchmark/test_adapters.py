"""External methods: maps of samples with known ground, in the benchmark's format."""

import ast
import math
from pathlib import Path

import numpy as np
import pytest

from lab.benchmark import adapters
from lab.benchmark.adapters import files
from lab.benchmark.adapters.cell_filter import cell_filter
from lab.benchmark.adapters.files import enter
from lab.benchmark.entries import read_map
from lab.benchmark.recordings import write_samples
from protocol.machine.samples import empty
from sim.truth import TruthMap

GROUND = np.zeros((30, 40), np.float32)


def samples() -> np.ndarray:
    """Two eastward lanes: dirt in the west, sand in the east."""
    rows = empty(128)
    along = np.tile(np.arange(64) * 0.5 + 2.0, 2)
    rows["stamp_ns"], rows["x_m"], rows["y_m"] = np.arange(128)[::-1] + 1, along, np.repeat([10.5, 11.5], 64)
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.5
    rows["c_rr"], rows["c_rr_var"] = np.where(along < 18, 0.04, 0.25), 1e-5
    rows["grade_e"], rows["grade_n"], rows["grade_var"] = 0.1, -0.05, 1e-5
    rows["c_rr"][5] = rows["c_rr_var"][5] = math.nan
    return rows


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    folder = tmp_path / "data" / "site-1"
    folder.mkdir(parents=True)
    write_samples(folder / "samples.csv", {"a": samples()})
    return tmp_path


def entered(method, recording: Path) -> dict[str, np.ndarray]:
    enter(method, recording / "data", recording / "entry")
    return read_map(recording / "entry" / "site-1.csv", TruthMap(0.0, 0.0, GROUND, GROUND, GROUND))


@pytest.mark.parametrize("name", ["cell_filter", "gaussian_process"])
def test_a_method_knows_both_kinds_of_ground_and_the_slope(name: str, recording: Path):
    if name == "gaussian_process":
        pytest.importorskip("sklearn", reason="needs the extra `entries`")
        from lab.benchmark.adapters.gaussian_process import gaussian_process as method
    else:
        method = cell_filter
    layers = entered(method, recording)
    assert layers["resistance"][10, 5] == pytest.approx(0.04, rel=0.05)
    assert layers["resistance"][11, 30] == pytest.approx(0.25, rel=0.05)
    assert layers["grade_east"][10, 20] == pytest.approx(0.1, abs=0.005)
    assert layers["grade_north"][10, 20] == pytest.approx(-0.05, abs=0.005)
    assert np.isnan(layers["resistance"][20, 20])
    if name == "gaussian_process":
        assert layers["confidence"][10, 5] > 0.9
        assert layers["confidence"][10, 17] < layers["confidence"][10, 5]


def test_adapters_import_nothing_of_this_project():
    for path in Path(adapters.__file__).parent.glob("*.py"):
        names = [
            node.module or "" for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.ImportFrom)
        ]
        ours = [name for name in names if name.split(".")[0] in ("protocol", "agents", "mapserver", "sim", "lab")]
        assert set(ours) <= {files.__name__}, path.name
