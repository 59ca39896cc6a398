"""Answers of the web server that need what it may not have."""

from __future__ import annotations

import asyncio
import sys
from typing import Any, cast

import pytest

from sitegrid.web.resource import as_features
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
