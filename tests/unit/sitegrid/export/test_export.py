"""A store's map as files, read back by foreign programs: same bits, right places, complete or missing."""

from __future__ import annotations

import json
import resource
import signal
import sqlite3
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import geopandas
import numpy as np
import pyarrow.csv
import pyarrow.parquet
import pyogrio
import pytest
import rasterio
from pyproj import CRS, Transformer
from rasterio.vrt import WarpedVRT
from rasterio.warp import calculate_default_transform

from mapserver.ingest.decisions import ground_decisions
from mapserver.journal import archived_decisions
from mapserver.journal.rows import JournalRow
from protocol.queries.requests import InfoQuery, RegionQuery
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.site.geometry import Bounds
from protocol.site.site_config import Projection
from sitegrid.cli import main
from sitegrid.commands.export import FORMS as OPTIONS
from sitegrid.export import maps
from sitegrid.export.command import FEATURES, FORMS
from tests.integration.hauling_site import haulers
from tests.unit.mapserver.data import open_writer
from tests.unit.mapserver.query.fake_upkeep import answers_of
from tests.unit.sitegrid.refold.archives import SITE, write

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning"),  # rasterio's own
]
UTM = "EPSG:32632"
FILES = {suffix: f"map{suffix}" if form.usual else f"{form.holds[-2]}{suffix}" for suffix, form in FORMS.items()}


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of haulers on three roads, one repaired, and its server's decisions."""
    folder, first = tmp_path_factory.mktemp("archive"), tmp_path_factory.mktemp("first") / "store"
    rows = [(one.name, table) for one in haulers() for table in one._days]
    write(folder, [JournalRow(i, name, 7, 1 + 10_000 * i, table, 1) for i, (name, table) in enumerate(rows, 1)])
    assert main(["fold", str(folder), "--out", str(first)]) == 0
    with closing(open_writer(first)) as writer:
        answers_of(writer).examine_roads()
        archived_decisions.save(folder, writer.store_id, writer.run(lambda store: ground_decisions(store.journal)))
    return folder


@pytest.fixture(scope="module")
def store(archive: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("store") / "store"
    assert main(["fold", str(archive), "--out", str(out)]) == 0
    return out


@pytest.fixture(scope="module")
def known(store: Path):
    """The same store, queried in process."""
    with maps.opened(SimpleNamespace(store=store, site_file=None, config=None)) as opened:
        yield opened


def export(file: Path, store: Path, *words: str) -> int:
    machine = ("--machine", "hauler-1") if file.suffix == ".tum" and "--machine" not in words else ()
    return main(["export", str(file), "--store", str(store), *machine, *words])


def test_a_geotiff_has_the_bits_of_the_map_at_its_places_also_in_another_projection(store, known, tmp_path):
    assert export(tmp_path / "map.tif", store) == 0
    info = known.ask(InfoQuery())
    west, south, east, north = info.bounds
    region = known.ask(RegionQuery(Bounds(west, south, east, north)))
    draw = np.random.default_rng(1)
    rows, columns = (draw.integers(0, count, 3000) for count in (len(region.y_m), len(region.x_m)))
    x_m, y_m = region.x_m[columns], region.y_m[rows]
    with rasterio.open(tmp_path / "map.tif") as tif:
        assert CRS(tif.crs.to_wkt()).equals(CRS(info.site.crs), ignore_axis_order=True)
        assert tif.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
        assert np.isnan(tif.nodata)
        assert dict(zip(tif.descriptions, tif.units, strict=True))["grade_east"] == "m/m"
        assert (tif.tags()["store"], int(tif.tags()["row"])) == (info.store, info.merged)
        read = np.array(list(tif.sample(zip(x_m, y_m, strict=True)))).T
        ours = np.stack([region[name][rows, columns] for name in tif.descriptions])
        assert np.isfinite(ours[0]).sum() > 100
        assert read.tobytes() == ours.tobytes()
        there = Transformer.from_crs(CRS(info.site.crs), UTM, always_xy=True)
        finely = calculate_default_transform(tif.crs, UTM, tif.width, tif.height, *tif.bounds, resolution=0.2)
        with WarpedVRT(tif, crs=UTM, **dict(zip(("transform", "width", "height"), finely, strict=True))) as warped:
            again = np.array(list(warped.sample(zip(*there.transform(x_m, y_m), strict=True)))).T
        assert np.array_equal(again, ours, equal_nan=True)


def test_a_surveyed_point_lies_where_pyproj_says(store, known, tmp_path):
    for name in ("map.tif", "segments.parquet", "segments.geojson"):
        assert export(tmp_path / name, store) == 0
    road = known.ask(SegmentsQuery()).segments[0]
    x_m, y_m = road.line[0]
    lat_deg, lon_deg, _ = Projection(SITE).to_geodetic(x_m, y_m)
    with rasterio.open(tmp_path / "map.tif") as tif:
        surveyed = Transformer.from_crs("EPSG:4326", tif.crs, always_xy=True).transform(lon_deg, lat_deg)
        assert surveyed == pytest.approx((x_m, y_m), abs=1e-6)
    metric = geopandas.read_parquet(tmp_path / "segments.parquet")
    assert metric.geometry.iloc[0].coords[0] == (x_m, y_m)
    first = geopandas.read_file(tmp_path / "segments.geojson").geometry.iloc[0].geoms[0]
    assert first.coords[0] == pytest.approx((lon_deg, lat_deg), abs=1e-8)
    moved = metric.geometry.to_crs("EPSG:4326").iloc[0].coords[0]
    assert moved == pytest.approx((lon_deg, lat_deg), abs=1e-8)


def test_a_geopackage_has_all_layers_and_a_style_for_each(store, known, tmp_path):
    file = tmp_path / "map.gpkg"
    assert export(file, store) == 0
    worklist = known.ask(WorklistQuery(limit=1000))
    counts = {
        "segments": len(known.ask(SegmentsQuery()).segments),
        "worklist": len(worklist.rows),
        "repairs": len(worklist.changes),
    }
    assert min(counts.values()) > 0
    assert set(FEATURES) <= {name for name, _ in pyogrio.list_layers(file)}
    for name in FEATURES:
        layer = geopandas.read_file(file, layer=name)
        assert len(layer) == counts.get(name, len(layer))
        assert layer.crs.equals(CRS(known.ask(InfoQuery()).site.crs), ignore_axis_order=True)
        assert layer.geometry.is_valid.all()
    kwh = geopandas.read_file(file, layer="worklist")["kwh_ph_high"].tolist()
    assert kwh == [row.kwh_ph[2] for row in worklist.rows]
    with closing(sqlite3.connect(file)) as database:
        styled = database.execute("SELECT f_table_name FROM layer_styles WHERE useAsDefault").fetchall()
        assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    assert {name for (name,) in styled} == set(FEATURES)


@pytest.mark.parametrize("what", FEATURES)
def test_every_form_of_features_has_the_same_ones(what, store, tmp_path):
    names = [f"{what}{suffix}" for suffix in (".geojson", ".fgb", ".parquet")]
    assert [export(tmp_path / name, store) for name in names] == [0, 0, 0]
    parquet = geopandas.read_parquet(tmp_path / names[2])
    for name in names[:2]:
        other = geopandas.read_file(tmp_path / name).to_crs(parquet.crs)
        if len(other) or name.endswith(".fgb"):  # empty GeoJSON has no columns
            assert [*other.columns] == [*parquet.columns]
        assert sorted(other.length) == pytest.approx(sorted(parquet.length), rel=1e-3)
        assert len(other) == len(parquet)
        assert other.total_bounds == pytest.approx(parquet.total_bounds, abs=0.01, nan_ok=True)


def test_dxf_has_outlines_and_roads_on_layers_of_their_own(store, tmp_path):
    assert export(tmp_path / "map.dxf", store) == 0
    lines = geopandas.read_file(tmp_path / "map.dxf")
    assert {"segments", "zones gravel"} <= set(lines["Layer"])
    assert "$INSUNITS\n 70\n6" in (tmp_path / "map.dxf").read_text().replace("\r", ""), "metres"
    assert lines.total_bounds == pytest.approx((8, 8, 161, 132), abs=3)


def test_samples_have_their_identity_and_are_those_that_were_sent(store, tmp_path):
    for name in ("samples.parquet", "samples.csv"):
        assert export(tmp_path / name, store) == 0
    table = pyarrow.parquet.read_table(tmp_path / "samples.parquet")
    sent = {one.name: np.concatenate(one._days) for one in haulers()}
    assert len(table) == sum(map(len, sent.values()))
    identities = zip(*(table.column(name).to_pylist() for name in ("machine", "spool_id", "seq")), strict=True)
    assert len(set(identities)) == len(table)
    of_one = table.filter(pyarrow.compute.equal(table["machine"], "hauler-3"))
    assert of_one["x_m"].to_numpy().tobytes() == sent["hauler-3"]["x_m"].tobytes()
    assert of_one["mass_kg"].null_count == len(of_one), "not known"
    text = pyarrow.csv.read_csv(tmp_path / "samples.csv")
    assert text["c_rr"].to_numpy().astype(np.float32).tobytes() == table["c_rr"].to_numpy().tobytes()


def test_samples_are_chosen_by_machine_place_and_time(store, tmp_path):
    words = ("--machine", "hauler-1", "--bounds", "0", "0", "50", "50", "--as-of", "-1d")
    assert export(tmp_path / "samples.csv", store, *words) == 0
    some = pyarrow.csv.read_csv(tmp_path / "samples.csv").to_pydict()
    every = np.concatenate([table for one in haulers() for table in one._days])
    its = np.concatenate(haulers()[0]._days)
    inside = (its["x_m"] <= 50) & (its["y_m"] <= 50) & (its["stamp_ns"] <= every["stamp_ns"].max() - 86_400 * 10**9)
    assert sorted(some["stamp_ns"]) == sorted(its["stamp_ns"][inside].tolist())


def test_a_track_is_in_the_order_of_time_with_its_heading(store, tmp_path):
    assert export(tmp_path / "map.tum", store) == 0
    track = np.loadtxt(tmp_path / "map.tum")
    assert (np.diff(track[:, 0]) >= 0).all()
    assert np.hypot(track[:, 6], track[:, 7]) == pytest.approx(np.ones(len(track)))
    assert len(track) == sum(map(len, haulers()[0]._days))


def test_cells_as_text_are_the_known_ones(store, known, tmp_path):
    assert export(tmp_path / "map.csv", store, "--layers", "resistance", "--bounds", "0", "0", "100", "100") == 0
    table = pyarrow.csv.read_csv(tmp_path / "map.csv")
    region = known.ask(RegionQuery(Bounds(0, 0, 100, 100), ("resistance",)))
    rows, columns = np.nonzero(np.isfinite(region["resistance"]))
    assert table["x_m"].to_pylist() == region.x_m[columns].tolist()
    assert table["resistance"].to_numpy().astype(np.float32).tobytes() == region["resistance"][rows, columns].tobytes()
    lat_deg, lon_deg, _ = Projection(SITE).to_geodetic(table["x_m"][0].as_py(), table["y_m"][0].as_py())
    assert (table["lat_deg"][0].as_py(), table["lon_deg"][0].as_py()) == pytest.approx((lat_deg, lon_deg))


def test_the_report_is_one_page_with_ten_sections_and_needs_nothing_else(store, tmp_path):
    assert export(tmp_path / "shift.html", store) == 0
    page = (tmp_path / "shift.html").read_text()
    assert "data:image/png;base64," in page
    assert "http" not in page.replace("http-equiv", "")
    worst = page.partition("Worst road sections")[2].partition("<h2>")[0]
    assert worst.count("<tr>") == 1 + 10
    assert "sections became better and save" in page
    assert "hauler-2" in page.partition("Data quality")[2]


def test_an_archive_gives_the_map_of_its_store(archive, store, tmp_path):
    assert export(tmp_path / "a.csv", archive) == export(tmp_path / "b.csv", store) == 0
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_zones_are_cut_at_the_bounds(store, tmp_path):
    assert export(tmp_path / "zones.parquet", store, "--bounds", "20", "0", "60.5", "40") == 0
    cut = geopandas.read_parquet(tmp_path / "zones.parquet")
    assert export(tmp_path / "zones.parquet", store) == 0
    every = geopandas.read_parquet(tmp_path / "zones.parquet").clip((20, 0, 61, 40))
    assert cut.total_bounds == pytest.approx(every.total_bounds)
    assert cut.area.sum() == pytest.approx(every.area.sum(), rel=0.02), "without the cells of noise at the edge"


@pytest.mark.parametrize("suffix", FORMS)
def test_a_full_disk_leaves_the_file_that_was_there_and_is_one_line(suffix, store, tmp_path, capsys):
    file = tmp_path / FILES[suffix]
    file.write_text("old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (500, limits[1]))
    try:
        assert export(file, store) == 1
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    problem = capsys.readouterr().err
    assert problem.count("\n") == 1, problem
    assert problem.startswith("sitegrid: ")
    assert [(path.name, path.read_text()) for path in tmp_path.iterdir()] == [(file.name, "old")]
    assert export(file, store) == 0
    assert file.read_bytes() != b"old"


def test_a_kill_in_the_middle_leaves_the_file_that_was_there(store, tmp_path):
    file = tmp_path / "map.tif"
    file.write_text("old")
    kill = "import os, sys; os.fsync = lambda _: os.kill(os.getpid(), 9)"
    code = f"{kill}; from sitegrid.cli import main; main(sys.argv[1:])"
    done = subprocess.run([sys.executable, "-c", code, "export", file, "--store", store], check=False)
    assert done.returncode == -signal.SIGKILL
    assert file.read_text() == "old"
    assert len([*tmp_path.iterdir()]) == 2, "what was written lies beside it"
    assert export(file, store) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["map.tif"]


REFUSED = {
    "an unknown form": (["map.shp"], "name it"),
    "no folder": (["nowhere/map.tif"], "there is no folder"),
    "a table of nothing": (["map.geojson"], "name it with --what"),
    "two tables": (["map.fgb", "--what", "zones,segments"], "holds one of"),
    "what a form cannot hold": (["map.tif", "--what", "zones"], "holds one of cells"),
    "layers of roads": (["segments.fgb", "--layers", "grade"], "--layers: is of cells"),
    "a machine's cells": (["map.csv", "--machine", "hauler-1"], "--machine: is of segments"),
    "larger samples": (["samples.csv", "--resolution", "5"], "--resolution: is of cells"),
    "ground that nobody knows": (["map.tif", "--bounds", "900", "900", "950", "950"], "the map lies at"),
    "a time before all": (["map.tif", "--as-of", "2020-01-01"], "the map lies at"),
    "samples of a time before all": (["samples.csv", "--as-of", "2020-01-01"], "the map lies at"),
    "bounds the wrong way round": (["map.tif", "--bounds", "9", "9", "1", "1"], "west must be below east"),
    "too large": (["map.tif", "--bounds", "0", "0", "9000", "9000"], "give --bounds"),
    "a layer that is none": (["map.tif", "--layers", "gold"], "`gold` is not known"),
    "an unknown machine": (["samples.csv", "--machine", "truck-9"], "has sent nothing"),
    "a track of several": (["all.tum", "--machine", ""], "of one machine"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_written_is_refused_in_one_line_and_makes_no_file(name, store, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (file, *words), problem = REFUSED[name]
    assert export(Path(file), store, *words) == 1
    said = capsys.readouterr().err
    assert problem in said
    assert said.count("\n") == 1
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize("suffix", [suffix for suffix in FORMS if suffix not in (".html", ".tum")])
def test_a_library_that_is_not_installed_is_named_with_its_extra(suffix, store, tmp_path, monkeypatch, capsys):
    for name in [name for name in sys.modules if name.startswith(("sitegrid.export.", "sitegrid.features."))]:
        if name not in ("sitegrid.export.command", "sitegrid.export.maps", "sitegrid.export.wanted"):
            monkeypatch.delitem(sys.modules, name)
    for library in ("rasterio", "pyogrio", "pyarrow", "pyogrio.raw", "pyarrow.csv"):
        monkeypatch.setitem(sys.modules, library, None)
    assert export(tmp_path / FILES[suffix], store) == 1
    assert "pip install '.[export" in capsys.readouterr().err


def test_the_command_takes_the_forms_that_there_are():
    assert set(OPTIONS) == set(FORMS)


def test_what_was_written_is_named_for_programs(store, tmp_path, capsys):
    capsys.readouterr()
    assert export(tmp_path / "map.tif", store, "--json", "--resolution", "4") == 0
    said = json.loads(capsys.readouterr().out)
    assert (said["file"], said["holds"]["layers"], said["site"]) == (str(tmp_path / "map.tif"), 12, "pit")
    with rasterio.open(tmp_path / "map.tif") as tif:
        assert tif.res == (4.0, 4.0)
