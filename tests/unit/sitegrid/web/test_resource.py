"""Answers of the web server that need what it may not have."""

from __future__ import annotations

import asyncio
import sys
from typing import Any, cast

import pytest

from protocol.errors import QueryError
from protocol.queries.request import Parameter
from sitegrid.web.resource import LAT_LON, as_features
from sitegrid.web.values import RequestProblem


class Feed:
    async def projection(self) -> None: ...


def test_flat_geobuf_without_gdal_says_what_to_install_and_what_needs_nothing(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "pyogrio.raw", None)
    monkeypatch.delitem(sys.modules, "sitegrid.features.gdal", raising=False)
    with pytest.raises(RequestProblem) as raised:
        asyncio.run(as_features(cast(Any, Feed()), {"format": "fgb"}, "zones", cast(Any, None)))
    assert raised.value.status == 400
    assert str(raised.value).endswith("pip install '.[export]' where the web server runs; geojson needs nothing")


@pytest.mark.parametrize(("parameter", "text"), [(LAT_LON[0], "90.1"), (LAT_LON[0], "-91"), (LAT_LON[1], "361")])
def test_a_place_beyond_the_earth_is_refused_by_name(parameter: Parameter, text: str):
    value = parameter.read({parameter.name: text})
    with pytest.raises(QueryError, match=f"`{parameter.name}`"):
        parameter.check(value)
