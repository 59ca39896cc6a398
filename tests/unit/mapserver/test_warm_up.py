"""What a process has compiled before it says that it is ready."""

import json
import subprocess
import sys

import pytest

ASK = """
import json, sys, tempfile
from contextlib import closing
from pathlib import Path
from numba.core.dispatcher import Dispatcher
from mapserver.config import ServerConfig
from mapserver.server import warm_up
from protocol.queries.roads import SegmentsQuery, WorklistQuery
from protocol.queries.route_requests import RouteQuery, WayQuery
from tests.unit.mapserver.data import incoming, open_writer, send
from tests.unit.mapserver.query.fake_upkeep import answered, answers_of
from tests.unit.mapserver.roads.drives import along, passes
def ready():
    for name, module in list(sys.modules.items()):
        if name.startswith(("mapserver.roads.", "mapserver.routes.")):
            for kernel, value in vars(module).items():
                if isinstance(value, Dispatcher) and value.signatures:
                    yield f"{name}.{kernel}"
warm_up(ServerConfig())
before = sorted(set(ready()))
with tempfile.TemporaryDirectory() as folder, closing(open_writer(Path(folder))) as writer:
    send(writer, [incoming(passes(along([(10, 10), (210, 10), (210, 90)]), 6), machine="a")])
    send(writer, [incoming(passes(along([(110, 10), (110, 90)]), 6, 0.05), machine="b")])
    answers = answers_of(writer)
    line = ((12.0, 10.0), (150.0, 10.0))
    for query in (SegmentsQuery(), WorklistQuery(), RouteQuery(line), WayQuery(*line)):
        answered(answers, query.name, query.parameters())
print(json.dumps([before, sorted(set(ready()))]))
"""


@pytest.mark.nightly
def test_nobody_who_asks_for_roads_and_routes_waits_for_a_kernel():
    done = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=False, timeout=170)
    assert done.returncode == 0, done.stderr
    before, after = json.loads(done.stdout)
    assert len(before) > 10
    assert after == before
