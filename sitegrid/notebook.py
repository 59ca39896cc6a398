"""Answers in notebooks: regions as dataset, table, plot; roads and changes as GeoDataFrames.

Libraries come with the extra `notebook`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from protocol.arrays import AnyArray, Bools
from protocol.queries.answers import Region, SiteInfo

if TYPE_CHECKING:
    import pandas as pd
    import pyproj
    import xarray
from typing import TYPE_CHECKING

from protocol.queries.answers import ChangesAnswer
from protocol.queries.roads import Segments, Worklist
from sitegrid.features.feature import Collection, shape_of
from sitegrid.features.kinds import CHANGE, SEGMENT, WORK

if TYPE_CHECKING:
    import geopandas

UNITS = {"grade": "m/m", "heading": "rad", "weight": "m", "age": "s", "changed": "s"}  # by first word; others: 1


@dataclass(frozen=True, repr=False)
class MapRegion(Region):
    """A region with its site. site, where: queried on demand."""

    site: Callable[[], SiteInfo] = field(kw_only=True, compare=False)
    where: Callable[[], str] = field(kw_only=True, compare=False)

    @classmethod
    def from_region(cls, region: Region, site: Callable[[], SiteInfo], where: Callable[[], str]) -> MapRegion:
        """Attach a site to a region."""
        return cls(**{one.name: getattr(region, one.name) for one in fields(Region)}, site=site, where=where)

    def __repr__(self) -> str:
        known = any(np.isfinite(values).any() for values in self.layers.values())
        return super().__repr__() if known else f"{super().__repr__()[:-1]}; {self.where()}>"

    @property
    def crs(self) -> pyproj.CRS:
        """The site's frame: metres east and north of its origin, transverse Mercator."""
        from pyproj import CRS

        return CRS.from_user_input(self.site().crs)

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Affine from (column, row) to `map`, as in rasterio; rows go north."""
        edge = self.bounds
        return self.cell_m, 0.0, edge.west_m, 0.0, self.cell_m, edge.south_m

    def to_xarray(self) -> xarray.Dataset:
        """Layers over y and x, with units and frame by the CF conventions."""
        import xarray

        axes = {
            name: (name, values, {"units": "m", "standard_name": f"projection_{name}_coordinate", "axis": name.upper()})
            for name, values in (("y", self.y_m), ("x", self.x_m))
        }
        frame = ((), 0, self.crs.to_cf())
        layers = {
            name: (("y", "x"), values, {"units": unit_of(name), "grid_mapping": "spatial_ref"})
            for name, values in self.layers.items()
        }
        version = {"site": self.site().name, "store": self.version.store, "journal_row": self.version.row}
        about = {"Conventions": "CF-1.11", **version, "stamp_ns": self.stamp_ns}
        return xarray.Dataset(layers, {**axes, "spatial_ref": frame}, about)

    def to_pandas(self) -> pd.DataFrame:
        """One row per cell with a known layer: centre x_m, y_m, and layers."""
        import pandas as pd

        y_m, x_m = np.meshgrid(self.y_m, self.x_m, indexing="ij")
        known: Bools = np.any([np.isfinite(values) for values in self.layers.values()], axis=0)
        columns: dict[str, AnyArray] = {"x_m": x_m, "y_m": y_m, **self.layers}
        return pd.DataFrame({name: values[known] for name, values in columns.items()})

    def plot(self, layer: str | None = None, axes: Any = None, **style: Any) -> Any:
        """Draw one layer, by default the first, with matplotlib; returns the axes. style: of `imshow`."""
        from matplotlib import pyplot as plt

        name, edge = layer or next(iter(self.layers)), self.bounds
        axes = axes or plt.figure().add_subplot()
        extent = (edge.west_m, edge.east_m, edge.south_m, edge.north_m)
        image = axes.imshow(self[name], origin="lower", extent=extent, **{"interpolation": "nearest", **style})
        axes.set(xlabel="east [m]", ylabel="north [m]", title=f"{self.site().name}: {name}")
        axes.figure.colorbar(image, ax=axes, label=f"{name} [{unit_of(name)}]")
        return axes

    def _repr_html_(self) -> str:
        head = "<tr><th>layer</th><th>known</th><th>least</th><th>mean</th><th>most</th></tr>"
        rows = (
            f"<tr><td>{escape(name)}</td>" + "".join(f"<td>{text}</td>" for text in _summary(values)) + "</tr>"
            for name, values in self.layers.items()
        )
        return f"<div>{escape(repr(self))}</div><table>{head}{''.join(rows)}</table>"


def unit_of(layer: str) -> str:
    """Unit of a layer's values."""
    return "1" if layer.endswith("_class") else UNITS.get(layer.partition("_")[0], "1")


def _summary(values: Any) -> tuple[str, str, str, str]:
    known = values[np.isfinite(values)]
    if not known.size:
        return "0 %", "", "", ""
    least, mean, most = (f"{end(known):.4g}" for end in (np.min, np.mean, np.max))
    return f"{known.size / values.size:.0%}", least, mean, most


def to_geopandas(answer: Segments | Worklist | ChangesAnswer, crs: str) -> geopandas.GeoDataFrame:
    """One row per segment, worklist row or change, with the columns of exported files."""
    import geopandas
    from shapely.geometry import shape

    match answer:
        case Segments():
            features = Collection(SEGMENT, answer.segments)
        case Worklist():
            features = Collection(WORK, answer.rows)
        case ChangesAnswer():
            features = Collection(CHANGE, answer.changes)
    rows = [
        {**features.properties(one), "geometry": shape(shape_of(features.kind, one, None))} for one in features.items
    ]
    return geopandas.GeoDataFrame(rows, columns=[*features.kind.fields, "geometry"], geometry="geometry", crs=crs)
