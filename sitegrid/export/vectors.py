"""Features for GIS and CAD: GeoPackage, FlatGeobuf, GeoJSON, DXF."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from html import escape
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

from protocol.arrays import Floats
from protocol.errors import StoreError
from protocol.site.ground_classes import ZONES
from sitegrid.export.collections import COLLECTIONS
from sitegrid.export.wanted import Wanted
from sitegrid.features.feature import Collection, FeatureKind
from sitegrid.features.gdal import LAT_LON, columns, in_memory, write

ENTITY = FeatureKind("LineString", lambda entity: [entity[1]], {"Layer": (str, "0")})  # for DXF
# QGIS 3.22 warns of GDAL's default version.
GPKG_VERSION = "1.3"
# Schema by QGIS ("Saving styles in a database").
STYLES = """
CREATE TABLE layer_styles (
    id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL, f_table_catalog TEXT, f_table_schema TEXT, f_table_name TEXT,
    f_geometry_column TEXT, styleName TEXT, styleQML TEXT, styleSLD TEXT, useAsDefault BOOLEAN, description TEXT,
    owner TEXT, ui TEXT, update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ', 'now')));
INSERT INTO gpkg_contents (table_name, data_type, identifier) VALUES ('layer_styles', 'attributes', 'layer_styles');
"""
STYLE = """INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName,
    styleQML, styleSLD, useAsDefault, description, owner) VALUES ('', '', ?, 'geom', ?, ?, '', 1, '', '')"""
BAD, DONE, DARK = (200, 30, 30), (30, 90, 200), (60, 60, 60)  # red, green, blue
LINES = {"worklist": (BAD, 1.4), "repairs": (DONE, 1.4), "tracks": (DARK, 0.2)}  # colour, width [mm]
Colour = tuple[int, int, int]


def write_gpkg(file: BinaryIO, wanted: Wanted, what: Sequence[str]) -> dict[str, int]:
    """A layer per kind in the site's frame, with a style that QGIS applies by itself."""
    tables = {name: columns(COLLECTIONS[name](wanted)) for name in what}
    with TemporaryDirectory(prefix="sitegrid-export-") as folder:
        path = Path(folder) / "map.gpkg"
        try:
            for name, table in tables.items():
                options = {} if path.exists() else {"dataset_options": {"VERSION": GPKG_VERSION}}
                write(path, "GPKG", table, name, wanted.info.site.crs, **options)
            _add_styles(path, {name: style_of(name, wanted.info.boundaries) for name in what})
        except (RuntimeError, sqlite3.Error) as error:  # pyogrio's errors have no other base
            raise StoreError(folder, f"{error}; make room there, or have TMPDIR name another place") from None
        with path.open("rb") as made:
            shutil.copyfileobj(made, file)
    return {name: len(table.shapes) for name, table in tables.items()}


def _add_styles(path: Path, styles: Mapping[str, str]) -> None:
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.executescript(STYLES)
        connection.executemany(STYLE, [(name, name, style) for name, style in styles.items()])


def write_geojson(file: BinaryIO, wanted: Wanted, what: Sequence[str]) -> dict[str, int]:
    """GeoJSON in longitude and latitude."""
    return _in_degrees("GeoJSON", file, wanted, what[0])


def write_fgb(file: BinaryIO, wanted: Wanted, what: Sequence[str]) -> dict[str, int]:
    """FlatGeobuf in longitude and latitude."""
    return _in_degrees("FlatGeobuf", file, wanted, what[0])


def _in_degrees(driver: str, file: BinaryIO, wanted: Wanted, what: str) -> dict[str, int]:
    table = columns(COLLECTIONS[what](wanted), wanted.projection)
    file.write(in_memory(driver, table, what, LAT_LON))
    return {what: len(table.shapes)}


def write_dxf(file: BinaryIO, wanted: Wanted, what: Sequence[str]) -> dict[str, int]:
    """Lines in metres of the site's frame for CAD; areas as outlines, a layer per kind."""
    collections = {name: COLLECTIONS[name](wanted) for name in what}
    entities = {name: list(_entities(name, collection)) for name, collection in collections.items()}
    table = columns(Collection(ENTITY, [entity for some in entities.values() for entity in some]))
    file.write(in_memory("DXF", table, "entities", wanted.info.site.crs))
    return {f"lines of {name}": len(some) for name, some in entities.items()}


def _entities(name: str, collection: Collection) -> Iterator[tuple[str, Floats]]:
    """Lines with layer names."""
    for item in collection.items:
        properties = collection.properties(item)
        kind = properties.get("name") or properties.get("machine") if name in ("zones", "tracks") else ""
        for line in collection.kind.lines(item):
            yield f"{name} {kind}".strip(), line


def style_of(layer: str, boundaries: Sequence[float]) -> str:
    """QGIS style of a layer. boundaries: between resistance classes."""
    if layer == "zones":
        rows = [(f"value='{kind}'", name, _fill(colour)) for kind, (name, colour) in enumerate(_classes(boundaries))]
        return _qml("categorizedSymbol", "class", "categories", "category", rows)
    if layer == "segments":
        ends = [0.0, *boundaries, 1.0]
        classes = zip(ends, ends[1:], _classes(boundaries), strict=False)
        ranges = [(f"lower='{low}' upper='{high}'", name, _line(colour, 0.9)) for low, high, (name, colour) in classes]
        return _qml("graduatedSymbol", "resistance", "ranges", "range", ranges)
    symbol = _line(*LINES[layer]) if layer in LINES else _outline(BAD)
    return _qml("singleSymbol", "", "", "", [("", "", symbol)])


def _classes(boundaries: Sequence[float]) -> list[tuple[str, Colour]]:
    """Names and colours of ground classes; unusual classes are numbered."""
    usual = len(boundaries) + 1 == len(ZONES)
    zones = [ZONES[kind % len(ZONES)] for kind in range(len(boundaries) + 1)]
    return [(zone.name if usual else str(kind), zone.bgr[::-1]) for kind, zone in enumerate(zones)]


def _qml(kind: str, attribute: str, plural: str, single: str, rows: Iterable[tuple[str, str, str]]) -> str:
    """A renderer from rows of (selector, label, symbol)."""
    known = list(enumerate(rows))
    parts = [f"<{single} {what} symbol='{i}' label='{escape(name)}' render='true'/>" for i, (what, name, _) in known]
    listed = f"<{plural}>{''.join(parts)}</{plural}>" if plural else ""
    symbols = "".join(symbol.format(name=i) for i, (_, _, symbol) in known)
    head = f"<renderer-v2 type='{kind}' attr='{attribute}' symbollevels='0' enableorderby='0'>"
    return f"<qgis styleCategories='Symbology'>{head}{listed}<symbols>{symbols}</symbols></renderer-v2></qgis>"


def _fill(colour: Colour) -> str:
    return _symbol("fill", "SimpleFill", color=_text(colour, 170), style="solid", outline_style="no")


def _outline(colour: Colour) -> str:
    return _symbol("fill", "SimpleFill", style="no", outline_color=_text(colour, 255), outline_width="0.6")


def _line(colour: Colour, width_mm: float) -> str:
    return _symbol("line", "SimpleLine", line_color=_text(colour, 255), line_width=str(width_mm))


def _text(colour: Colour, alpha: int) -> str:
    return ",".join(map(str, (*colour, alpha)))


def _symbol(kind: str, layer: str, **options: str) -> str:
    """A symbol; its name is left as a placeholder."""
    listed = "".join(f"<Option type='QString' name='{name}' value='{value}'/>" for name, value in options.items())
    inner = f"<layer class='{layer}' enabled='1' pass='0' locked='0'><Option type='Map'>{listed}</Option></layer>"
    return f"<symbol type='{kind}' name='{{name}}' alpha='1' clip_to_extent='1' force_rhr='0'>{inner}</symbol>"
