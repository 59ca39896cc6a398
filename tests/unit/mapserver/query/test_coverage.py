"""Coverage agrees with the layers of the same cells."""

from contextlib import closing

import numpy as np
import pytest

from protocol.queries.coverage import CoverageQuery
from protocol.queries.requests import RegionQuery, parse_query
from protocol.site.geometry import Bounds
from tests.unit.mapserver.data import SITE, incoming, open_writer, random_samples, send
from tests.unit.mapserver.query.fake_upkeep import answers_of


@pytest.fixture(scope="module")
def answers(tmp_path_factory):
    with closing(open_writer(tmp_path_factory.mktemp("store"))) as writer:
        send(
            writer,
            [incoming(random_samples(2000, seed=3), machine="a"), incoming(random_samples(500, seed=4), machine="b")],
        )
        yield answers_of(writer)


@pytest.mark.parametrize("bounds", [None, Bounds(-20.5, -3.0, 13.0, 20.0), Bounds(4000.0, 0.0, 4001.0, 1.0)])
def test_coverage_is_what_the_layers_of_its_cells_say(answers, bounds):
    query = CoverageQuery(bounds)
    sent = parse_query("coverage", query.parameters())
    answer = query.decode(answers.answer(sent))
    region = answers.region(RegionQuery(bounds or Bounds(-64.0, -64.0, 64.0, 64.0), ("visits", "resistance", "age_s")))
    driven = np.nan_to_num(region["visits"]) > 0
    assert answer.driven_m2 == driven.sum() * SITE.cell_m**2
    assert answer.known_m2 == np.isfinite(region["resistance"]).sum() * SITE.cell_m**2
    for name, seconds in (("hour", 3600), ("day", 86_400), ("week", 7 * 86_400)):
        assert answer.driven_since_m2[name] == (driven & (region["age_s"] <= seconds)).sum() * SITE.cell_m**2
    assert set(answer.machines_m2) == {"a", "b"}
    assert max(answer.machines_m2.values()) <= answer.driven_m2 <= sum(answer.machines_m2.values())
