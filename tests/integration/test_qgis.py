"""QGIS reads exports and an empty web layer; skipped without Debian's `python3-qgis`."""

from __future__ import annotations

import json
import os
import subprocess
from typing import Any

import numpy as np
import pytest

from protocol.site.geometry import Bounds
from sitegrid.cli import main
from sitegrid.export.command import FEATURES
from tests.integration.web_site import NAME, WebSite
from tests.patience import PATIENCE_S

PYTHON = os.environ.get("QGIS_PYTHON", "/usr/bin/python3")
SCRIPT = """
import json, os, sys
from qgis.core import QgsApplication, QgsPointXY, QgsRasterLayer, QgsVectorLayer, QgsWkbTypes
asked = json.load(sys.stdin)
application = QgsApplication([], False)
application.initQgis()
raster = QgsRasterLayer(asked["tif"], "cells")
provider = raster.dataProvider()
names = [raster.bandName(band).split(": ")[1] for band in range(1, raster.bandCount() + 1)]
values = [[provider.sample(QgsPointXY(*place), band)[0] for place in asked["places"]] for band in (1, 2)]
layers = {}
for name, source in asked["layers"].items():
    layer = QgsVectorLayer(source, name, "ogr")
    shape = QgsWkbTypes.displayString(layer.wkbType())
    layers[name] = [layer.isValid(), shape, layer.renderer().type(), [field.name() for field in layer.fields()]]
print(json.dumps({"names": names, "crs": raster.crs().toProj(), "values": values, "layers": layers}))
sys.stdout.flush()
os._exit(0)
"""


def qgis(asked: dict[str, Any]) -> Any:
    words = {"input": json.dumps(asked), "capture_output": True, "text": True, "timeout": PATIENCE_S, "check": True}
    environment = {**os.environ, "QT_QPA_PLATFORM": "offscreen", "PYTHONPATH": ""}
    return json.loads(subprocess.run([PYTHON, "-c", SCRIPT], env=environment, **words).stdout)


@pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # rasterio's own
@pytest.mark.nightly
@pytest.mark.processes
def test_qgis_reads_the_same_bits_and_applies_the_styles(hauling: WebSite, tmp_path):
    if subprocess.run([PYTHON, "-c", "import qgis.core"], capture_output=True, check=False).returncode:
        pytest.skip("QGIS is not installed: apt-get install python3-qgis")
    for file in ("map.tif", "map.gpkg"):
        assert main(["export", str(tmp_path / file), "--endpoint", hauling.endpoint, "--site", NAME]) == 0
    region = hauling.client.region(Bounds(0, 0, 170, 140), ["resistance", "resistance_std"])
    draw = np.random.default_rng(1)
    rows, columns = (draw.integers(0, count, 3000) for count in (len(region.y_m), len(region.x_m)))
    places = np.stack([region.x_m[columns], region.y_m[rows]], axis=1).tolist()
    layers = {name: f"{tmp_path / 'map.gpkg'}|layername={name}" for name in FEATURES if name != "tracks"}
    layers["machines"] = f"{hauling.url}api/v1/sites/{NAME}/features/machines?format=fgb"
    seen = qgis({"tif": str(tmp_path / "map.tif"), "places": places, "layers": layers})
    assert seen["names"][:2] == [*region.layers]
    assert "+proj=tmerc" in seen["crs"]
    for values, layer in zip(seen["values"], region.layers.values(), strict=True):
        assert np.array_equal(np.array(values, np.float32), layer[rows, columns], equal_nan=True)
    assert all(is_valid for is_valid, *_ in seen["layers"].values())
    kinds = {name: renderer for name, (_, _, renderer, _) in seen["layers"].items()}
    assert (kinds["zones"], kinds["segments"]) == ("categorizedSymbol", "graduatedSymbol")
    assert seen["layers"]["machines"][1] == "Point"
    assert "speed_mps" in seen["layers"]["machines"][3], "though no machine lives"
