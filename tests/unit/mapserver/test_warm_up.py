"""Functions compiled before a process reports ready, and behind it."""

import json
import subprocess
import sys

import pytest

ASK = """
import json, sys, tempfile
from contextlib import closing
from pathlib import Path
import numpy as np
from numba.core.dispatcher import Dispatcher
from mapserver.config import ServerConfig
from mapserver.server import warm_up, warm_up_rest
from mapserver.upkeep.upkeep import Upkeep
from protocol.queries.lanes import LanesQuery
from protocol.queries.map_tiles import TilesQuery
from protocol.queries.requests import PointQuery, WhyQuery
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from tests.unit.mapserver.data import incoming, open_writer, past_of, send, wait_for
from tests.unit.mapserver.query.fake_upkeep import answered, answers_of
from tests.unit.mapserver.roads.drives import along, passes
def ready():
    for name, module in list(sys.modules.items()):
        if name.startswith("mapserver."):
            for kernel, value in vars(module).items():
                if isinstance(value, Dispatcher) and value.py_func.__module__ == name:
                    yield from (f"{name}.{kernel}{signature}" for signature in value.signatures)
warm_up(ServerConfig())
begun = set(ready())
with tempfile.TemporaryDirectory() as folder, closing(open_writer(Path(folder))) as writer:
    for machine, y_m in {"a": 10, "b": 14}.items():
        seq = 1
        for hours, c_rr in ((0, 0.02), (30, 0.02), (60, 0.2)):  # the ground changes
            lines = (along([(10, y), (210, y), (210, 90)]) for y in range(y_m - 8, y_m + 8))
            rows = np.concatenate([passes(line, 2, c_rr, after_s=3600.0 * hours) for line in lines])
            rows["applied_zero"] = 0.001
            send(writer, [incoming(rows, seq, machine)])
            seq += len(rows)
    send(writer, [incoming(rows[:1], 1, "c")])  # a column of one row is contiguous, which others are not
    answers, place = answers_of(writer), (50.0, 10.0)
    answered(answers, PointQuery.name, PointQuery(*place).parameters())
    late = sorted(set(ready()) - begun)
    list(warm_up_rest(ServerConfig()))
    before = sorted(ready())
    published = []
    with closing(Upkeep(writer, published.append, past_of(writer), answers.roads.repairs)) as upkeep:
        upkeep.calibrate(60.0)
        wait_for(lambda: published and upkeep._checkpointing._looked)  # the last job of a turn has nothing more to do
    line = ((12.0, 10.0), (150.0, 10.0))
    queries = (WhyQuery(*place), TilesQuery(), LanesQuery())
    for query in (*queries, SegmentsQuery(), WorklistQuery(), RouteQuery(line), WayQuery(*line)):
        answered(answers, query.name, query.parameters())
print(json.dumps([late, before, sorted(ready()), len(published)]))
"""


@pytest.mark.nightly
def test_a_batch_and_a_point_compile_nothing_once_a_server_is_ready_and_nothing_does_once_all_kernels_are_there():
    done = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=False, timeout=170)
    assert done.returncode == 0, done.stderr
    late, before, after, changes = json.loads(done.stdout)
    assert not late
    assert len(before) > 40
    assert changes
    assert after == before
