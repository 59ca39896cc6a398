import json
import math
from itertools import islice

import numpy as np
import pytest

from lab.speed.__main__ import main
from lab.speed.asking.query import GOALS
from lab.speed.asking.questions import LAYERS, PLACES, REGION_M, kinds
from lab.speed.merge_work import batches
from protocol.queries.requests import InfoQuery

NAMES = ["point", "points", "region", "route", "way", "info", "as_of"]


@pytest.mark.processes
@pytest.mark.slow
def test_query_asks_a_server_cold_and_warm_beside_a_service_that_answers_at_once(capsys) -> None:
    assert main(["query", "--json", "--hours", "0.1", "--queries", "3", "--seconds", "1", "--runs", "1"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["hours"], result["queries"]) == ("query", 0.1, 3)
    counts = {"way": 1, "as_of": 1}
    expected = [(state, name, counts.get(name, 3)) for state in ("cold", "warm") for name in NAMES]
    assert sorted((row["state"], row["query"], row["queries"]) for row in result["rows"]) == sorted(expected)
    for row in result["rows"]:
        assert row["empty_ms_median"] > 0
        assert row["ms_median"] <= row["ms_p99"]
    judged = {row["query"]: row["goal"] for row in result["rows"] if row["state"] == "warm" and row["goal"]}
    assert judged == {name: f"{figure} <= {limit:g}" for name, (figure, limit) in GOALS.items()}
    assert [row["load"] for row in result["ingest"]] == ["paced", "saturated"]
    for row in result["ingest"]:
        assert row["alone_samples_per_s"] > 0
        assert row["asked_answers"] + row["asked_refused"] == 20
        assert row["met"] == (row["loss"] <= 0.1)


@pytest.mark.slow
def test_no_place_is_asked_for_twice_and_all_are_where_somebody_drove() -> None:
    work = list(islice(batches(), 50))
    driven = np.concatenate([rows for _, rows in work])
    asked = kinds(work)
    assert isinstance(next(asked["info"]), InfoQuery)
    points, regions, past = (list(islice(asked[name], 100)) for name in ("point", "region", "as_of"))
    half = REGION_M / 2
    places = [(q.x_m, q.y_m) for q in points + past] + [(q.area.west_m + half, q.area.south_m + half) for q in regions]
    cells = set(map(tuple, np.floor(np.stack([driven["x_m"], driven["y_m"]], axis=1)).tolist()))
    assert len(set(places)) == 300
    assert set(places) <= cells
    assert all(q.layers == LAYERS for q in points + regions + past)
    assert {q.when.as_of_ns for q in past} <= set(driven["stamp_ns"].tolist())
    assert len(next(asked["points"]).places) == PLACES


def test_routes_follow_what_a_machine_drove() -> None:
    work = list(islice(batches(), 50))
    driven = {(float(x), float(y)) for _, rows in work for x, y in zip(rows["x_m"], rows["y_m"], strict=True)}
    for route in islice(kinds(work)["route"], 5):
        assert len(route.line) > 1
        assert set(route.line) <= driven
        assert all(math.dist(a, b) > 0 for a, b in zip(route.line[:-1], route.line[1:], strict=True))
