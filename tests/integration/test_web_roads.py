"""Roads, worklist, routes and cheapest lines over HTTP: the client's numbers; real processes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyogrio
import pytest

from protocol.queries.requests import PointQuery, RegionQuery
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from protocol.queries.routing import MACHINES
from protocol.site.geometry import Bounds
from protocol.site.site_config import Projection
from protocol.site.site_file import load_site
from sitegrid.web import values
from tests.integration.hauling_site import DAY_NS, DAYS, FIRST_NS
from tests.integration.web_site import NAME, WebSite

pytestmark = pytest.mark.processes
LINE = ((20.0, 10.0), (90.0, 10.0), (150.0, 12.5))


@pytest.fixture
def web(hauling: WebSite) -> WebSite:
    return hauling


def text_of(line: tuple[tuple[float, float], ...]) -> str:
    return ";".join(f"{x},{y}" for x, y in line)


def test_roads_and_worklist_are_the_clients(web: WebSite):
    assert web.get("segments").json == values.plain(web.client.ask(SegmentsQuery()))
    assert web.get("worklist").json == values.plain(web.client.ask(WorklistQuery()))
    one = web.get("segments", {"machine": "hauler-2"}).json
    assert one == values.plain(web.client.ask(SegmentsQuery(machine="hauler-2")))
    assert one != web.get("segments").json
    bounds = Bounds(0.0, 0.0, 200.0, 40.0)
    asked = {"target": 0.03, "efficiency": 0.4, "limit": 3, "bounds": "0,0,200,40"}
    answer = web.get("worklist", asked).json
    assert answer == values.plain(web.client.ask(WorklistQuery(0.03, efficiency=0.4, limit=3, bounds=bounds)))
    assert len(answer["rows"]) == 3
    some = web.get("segments", {"bounds": "0,0,200,40"}).json["segments"]
    assert 0 < len(some) < len(web.get("segments").json["segments"])


def test_the_worklist_tells_days_a_repair_and_guessed_masses(web: WebSite):
    answer = web.get("worklist").json
    worse = next(row for row in answer["rows"] if abs(row["segment"]["line"][0][1] - 10) < 5)
    assert worse["day_ns"] == [FIRST_NS + i * DAY_NS for i in range(DAYS)]
    assert worse["day_resistance"] == pytest.approx([0.04, 0.045, 0.05, 0.055], rel=0.06)
    assert worse["since_time"] == values.iso(worse["since_ns"])
    assert worse["segment"]["trend"] == pytest.approx(0.005, rel=0.2)
    by_road = {round(row["segment"]["line"][0][1] / 60): row["segment"]["guessed"] for row in answer["rows"]}
    assert by_road[2] is True
    assert by_road[0] is False
    assert answer["changes"], "one road was repaired"
    for change in answer["changes"]:
        assert (change["before"], change["after"]) == pytest.approx((0.05, 0.03), rel=0.06)
        assert change["saved_kwh_ph"] > 0


def test_the_worklist_of_a_time_is_of_what_was_known_then(web: WebSite):
    first = FIRST_NS + DAY_NS
    then = web.get("worklist", {"as_of": values.iso(first)}).json
    assert (
        then
        == web.get("worklist", {"as_of": first}).json
        == values.plain(web.client.ask(WorklistQuery(as_of_ns=first)))
    )
    assert not then["changes"]
    assert all(len(row["day_ns"]) == 1 for row in then["rows"])
    hours = web.get("segments", {"from": values.iso(first), "to": values.iso(first + DAY_NS)}).json
    assert hours == values.plain(web.client.ask(SegmentsQuery(from_ns=first, to_ns=first + DAY_NS)))


def test_lines_of_roads_are_where_gis_look_for_them(web: WebSite):
    projection = Projection(load_site(web.folder / "site.toml"))
    roads = web.client.ask(SegmentsQuery()).segments
    listed = web.get("features/segments").json["features"]
    assert [feature["properties"]["id"] for feature in listed] == [road.id for road in roads]
    for feature, road in zip(listed, roads, strict=True):
        line = [projection.to_map(lat, lon, 0.0)[:2] for lon, lat in feature["geometry"]["coordinates"]]
        assert np.array(line) == pytest.approx(np.array(road.line), abs=2e-3)
    meta, _, geometry, columns = pyogrio.raw.read(f"{web.url}api/v1/sites/{NAME}/features/worklist?limit=5")
    table = dict(zip(meta["fields"], columns, strict=True))
    rows = web.client.ask(WorklistQuery(limit=5)).rows
    assert (meta["geometry_type"], len(geometry)) == ("LineString", 5)
    assert table["kwh_ph_low"] == pytest.approx([row.kwh_ph[1] for row in rows])
    assert list(table["id"]) == [row.segment.id for row in rows]
    assert web.get("features/segments").headers["content-type"] == "application/geo+json"


def test_a_repaired_road_is_read_as_it_is_since(web: WebSite):
    change = web.client.ask(WorklistQuery()).changes[0]
    (feature, *_) = web.get("features/repairs").json["features"]
    assert feature["properties"]["id"] == change.id
    assert feature["properties"]["resistance_after"] == change.after
    assert len(feature["geometry"]["coordinates"]) == len(change.line)
    x_m, y_m = change.line[len(change.line) // 2]
    asked = {"x": x_m, "y": y_m, "layers": "resistance"}
    since = web.get("point", asked).json["values"]["resistance"]
    assert since == web.client.ask(PointQuery(x_m, y_m, ("resistance",))).values["resistance"]
    assert since == pytest.approx(change.after, rel=0.1)
    why = web.get("why", {"x": x_m, "y": y_m}).json
    assert why["values"]["resistance"] == pytest.approx(since)
    assert why["before"]["resistance"] == pytest.approx(change.before, rel=0.2)
    bounds = {"bounds": f"{x_m - 2},{y_m - 2},{x_m + 2},{y_m + 2}", "layers": "resistance"}
    area = Bounds(x_m - 2, y_m - 2, x_m + 2, y_m + 2)
    ours = web.client.ask(RegionQuery(area, ("resistance",)))
    answer = web.get("region", bounds).json["layers"]["resistance"]
    assert np.array_equal(np.array(answer, np.float32), ours["resistance"], equal_nan=True)
    many = web.get("points", {"places": f"{x_m},{y_m}", "layers": "resistance"}).json
    assert many["layers"]["resistance"] == [pytest.approx(since)]
    then = web.get("point", {**asked, "as_of": change.first_ns - 1}).json["values"]["resistance"]
    assert then == pytest.approx(change.before, rel=0.1), "as of a time, with the changes of then"


def test_a_route_and_the_cheapest_line_are_the_clients(web: WebSite):
    asked = {"line": text_of(LINE), "machine": "truck", "mass": 30_000, "step": 10, "stops": "begin"}
    answer = web.get("route", asked).json
    machine = replace(MACHINES["truck"], mass_kg=30_000.0)
    ours = web.client.ask(RouteQuery(LINE, machine=machine, step_m=10.0, stops=(True, False)))
    assert answer["steps"] == values.plain(vars(ours.steps))
    assert answer["line"] == ours.line_m.tolist()
    assert answer["totals"].pop("litres") == pytest.approx(ours.totals.litres)
    assert answer["totals"] == values.plain(ours.totals)
    assert (answer["store"], answer["merged"]) == (ours.version.store, ours.version.row)
    assert web.get("route", {**asked, "line": asked["line"].replace(";", ",")}).json["steps"] == answer["steps"]
    ends = {"from": "20,10", "to": "20,130", "machine": "loader", "cost": "time", "avoid": "60,70;80,70"}
    cheapest = web.get("way", ends).json
    avoid = ((60.0, 70.0), (80.0, 70.0))
    theirs = web.client.ask(WayQuery((20.0, 10.0), (20.0, 130.0), cost="time", avoid=avoid))
    assert cheapest["line"] == theirs.line_m.tolist()
    assert cheapest["totals"]["time_s"] == theirs.totals.time_s
    first = FIRST_NS + DAY_NS
    then = web.get("route", {**asked, "as_of": values.iso(first)}).json
    assert then["stamp_ns"] == first
    assert then["totals"]["energy_j"] < answer["totals"]["energy_j"], "the road became worse since"


def test_what_nobody_knows_is_null_and_told(web: WebSite):
    answer = web.get("route", {"line": "20,10;20,60"}).json
    unknown = answer["steps"]["unknown"]
    assert 0 < answer["totals"]["unknown"] < 1
    confidence = answer["steps"]["confidence"]
    assert [value is None for value in confidence] == [share == 1.0 for share in unknown]
    refused = web.get("route", {"line": "20,10;20,60", "unknown": "refuse"})
    assert (refused.status, refused.json["reason"]) == (400, "out_of_range")
    assert "unknown ground at 20" in refused.json["detail"]


def test_a_long_line_is_answered_or_named(web: WebSite):
    x = np.linspace(12.0, 158.0, 1500)
    line = ";".join(f"{a:.1f},{10 + 2 * (i % 2)}" for i, a in enumerate(x))
    assert web.get("route", {"line": line}).json["totals"]["length_m"] > 2500
    longer = web.get("route", {"line": ";".join([line] * 7)})  # 10 500 places
    assert (longer.status, longer.json["reason"]) == (414, "too_large")
