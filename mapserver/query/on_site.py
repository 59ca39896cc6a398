"""Refuses places far off a site, such as numbers of another frame."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from protocol.errors import QueryError, Refusal
from protocol.queries.parameters import ValueForm
from protocol.queries.places import Place, around, where_it_lies
from protocol.queries.request import MapQuery, groups
from protocol.queries.requests import HistoryQuery, PointQuery, WhyQuery
from protocol.site.geometry import Bounds
from protocol.site.site_config import SiteConfig


def check_on_site(query: MapQuery[Any], site: SiteConfig, bounds: Callable[[], Sequence[int] | None]) -> None:
    """Refuse places and areas beyond the site's extent.

    bounds: west, south, east, north of the map in cells, None if empty; used in refusals.
    """
    for name, places in _places(query).items():
        for x_m, y_m in places:
            if max(abs(x_m), abs(y_m)) > site.extent_m:
                problem = f"{x_m:.12g}, {y_m:.12g} m is off the site, which reaches {site.extent_m:g} m from its origin"
                problem = f"parameter `{name}`: {problem}: {where_it_lies(bounds(), site.cell_m)}"
                raise QueryError(Refusal.OUTSIDE_SITE, problem)


def _places(query: MapQuery[Any]) -> Mapping[str, Sequence[Place]]:
    """Places by the name of their parameter; of an area the one that is nearest to the origin."""
    places: dict[str, Sequence[Place]] = {}
    for field, group in groups(type(query)):
        value, one = getattr(query, field.name), group.parameters[0]
        if isinstance(value, Bounds):
            places[one.name] = (_nearest(value),)
        elif one.kind.form is ValueForm.RECTANGLE and value:
            places["polygon"] = (_nearest(around(value)),)
        elif one.kind.form is ValueForm.PLACES:
            places[one.name] = value
        elif one.kind.form is ValueForm.PLACE:
            places[one.name] = (value,)
    if isinstance(query, PointQuery | HistoryQuery | WhyQuery):
        places["x`, `y"] = ((query.x_m, query.y_m),)
    return places


def _nearest(area: Bounds) -> Place:
    return max(area.west_m, min(0.0, area.east_m)), max(area.south_m, min(0.0, area.north_m))
