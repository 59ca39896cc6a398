"""Routes through real processes: a long line, answers while samples come in, the command."""

from __future__ import annotations

import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from protocol.errors import QueryError
from protocol.queries.places import MAX_PLACES
from protocol.wire.session import free_endpoint
from sitegrid import MACHINES
from sitegrid.process.children import Children
from tests.command_lines import said
from tests.integration.site_run import NOBODY_DRIVES
from tests.integration.test_followers import Followed, Sender

pytestmark = [pytest.mark.processes, pytest.mark.nightly]


def test_a_line_of_ten_thousand_places_and_a_way_are_answered_while_samples_come_in(tmp_path: Path, children: Children):
    sim = NOBODY_DRIVES
    run = Followed(tmp_path, children, free_endpoint(), sim)
    run.start_router()
    server = run.serve()
    sender = Sender(run)
    with closing(sender.session), run.connect() as client:
        rows = [sender.send(machine, 200) for machine in "abcabc"]
        angle = np.linspace(0.0, 200 * math.pi, MAX_PLACES)
        circles = np.stack([35 * np.cos(angle), 35 * np.sin(angle)], axis=1)
        drive = client.route(circles.tolist(), MACHINES["truck"], after=rows[-1])
        assert drive.merged == rows[-1], f"server pid {server.pid}"
        assert drive.totals.length_m == pytest.approx(200 * math.pi * 35, rel=1e-3)
        assert drive.totals.energy_low_j < drive.totals.energy_j < drive.totals.energy_high_j
        with pytest.raises(QueryError, match=f"{MAX_PLACES + 1} places"):
            client.route([*circles.tolist(), (0.0, 0.0)])
        for machine in "abc":  # what is kept gives way to what comes in
            row = sender.send(machine, 200)
            way = client.way((-35.0, -35.0), (35.0, 30.0), max_grade=1.0, after=row)
            again = client.route(way.line_m.tolist(), after=row)
            assert way.merged >= row
            assert again.totals.energy_j == pytest.approx(way.totals.energy_j)
        counters = client.info().counters
        assert counters["layers_kept"] > 0
        words = ("query", "--endpoint", run.endpoint, "--site", run.site, "way", -35, -35, 35, 30)
        way = said(*words, "--set", "machine=truck", "--set", "max_grade=1", "--json").json
        assert way["line"][0] == [-35.0, -35.0]
