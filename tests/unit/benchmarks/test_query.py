import json
from itertools import islice

import numpy as np
import pytest

from benchmarks import query
from benchmarks.__main__ import main
from benchmarks.merge_work import batches
from protocol.queries.requests import InfoQuery


@pytest.mark.processes
def test_query_asks_a_server_cold_and_warm_beside_a_service_that_answers_at_once(capsys) -> None:
    assert main(["query", "--json", "--hours", "0.02", "--queries", "12"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["benchmark"], result["hours"], result["queries"]) == ("query", 0.02, 12)
    kinds = [("point", 12), ("region", 12), ("info", 12), ("as_of", 1)]
    expected = [(state, name, count) for state in ("cold", "warm") for name, count in kinds]
    assert [(row["state"], row["query"], row["queries"]) for row in result["rows"]] == expected
    for row in result["rows"]:
        assert 0 < row["empty_ms_median"] < row["ms_p99"]
        assert row["ms_median"] <= row["ms_p99"]
        assert row["goal"] == query.GOALS_MS[row["query"]]


def test_no_place_is_asked_for_twice_and_all_are_where_somebody_drove() -> None:
    driven = np.concatenate([rows for _, rows in islice(batches(), 50)])
    asked = query._queries(driven)
    assert isinstance(next(asked["info"]), InfoQuery)
    points, regions, past = (list(islice(asked[name], 100)) for name in ("point", "region", "as_of"))
    half = query.REGION_M / 2
    places = [(q.x_m, q.y_m) for q in points + past] + [
        (q.bounds.west_m + half, q.bounds.south_m + half) for q in regions
    ]
    cells = np.floor(np.stack([driven["x_m"], driven["y_m"]], axis=1))
    assert len(set(places)) == 300
    assert set(places) <= set(map(tuple, cells.tolist()))
    assert {q.when.as_of_ns for q in past} <= set(driven["stamp_ns"].tolist())
