"""Code path of a reader: modules passed by an agent's step, or a map server's answer.

moves: from one product module to another, in call order; returns: moves to a module left before.
"""

from __future__ import annotations

import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from types import FrameType
from typing import Any, cast

from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from lab import agent
from lab.speed.measure import Figures, rows_of
from lab.speed.site import SITE
from mapserver.config import ServerConfig
from mapserver.ingest.store import Incoming, Store
from mapserver.ingest.writer import Writer
from mapserver.journal.location import JournalLocation
from mapserver.past.past import StorePast
from mapserver.query.answering import Answers
from mapserver.query.server_source import ServerSource
from mapserver.upkeep.upkeep import Upkeep
from protocol.queries.request import MapQuery
from protocol.queries.requests import PointQuery, WhyQuery
from protocol.queries.roads import WorklistQuery
from protocol.wire.codec import encode_batch
from protocol.wire.messages import SampleBatch
from sitegrid.proof.figures import Row
from tests.site_work import BATCH, batches, samples_of, write_store

OPTIONS = {"hours": 0.05}
GOALS = {
    ("fix", "modules"): "<= 16",
    ("fix", "returns"): "<= 40",
    ("point, settled", "modules"): "<= 12",
    ("point, settled", "returns"): "<= 30",
    ("point, fresh ground", "modules"): "<= 20",
    ("point, fresh ground", "returns"): "<= 70",
    ("why", "modules"): "<= 16",
    ("why", "returns"): "<= 40",
    ("worklist", "modules"): "<= 25",
    ("worklist", "returns"): "<= 80",
}
PACKAGES = ("agents", "mapserver", "protocol", "sim", "sitegrid")
FIX = "agents.localisation.gps"  # only steps with a fix enter it
WARM_S, FOLLOWED_S = 30, 3  # driven before, and while fixes are traced


def run(hours: float) -> Iterator[Row]:
    """A fix in an agent, and map queries after `hours` of work."""
    yield from rows_of("fix", _fix())
    with tempfile.TemporaryDirectory() as path:
        for name, figures in _questions(Path(path), hours):
            yield from rows_of(name, figures)


def walked(work: Callable[[], object]) -> list[str]:
    """Product modules in the order of calls from `work`, on this thread."""
    modules, frames = list[str](), set[FrameType]()

    def note(frame: FrameType, event: str, _: object) -> None:
        name = str(frame.f_globals.get("__name__", ""))
        if event == "call" and frame not in frames and name.partition(".")[0] in PACKAGES:
            frames.add(frame)  # generators are called once but resumed often
            modules.append(name)

    sys.setprofile(note)
    try:
        work()
    finally:
        sys.setprofile(None)
    return modules


def counted(modules: list[str]) -> Figures:
    """Modules, moves and returns of a walk."""
    distinct, moves = len(set(modules)), sum(a != b for a, b in pairwise(modules))
    return {"modules": distinct, "moves": moves, "returns": moves - distinct + 1}


def _fix() -> Figures:
    """The shortest fix-filtering step of single readings."""
    pipeline, seconds = Pipeline(agent.SITE, agent.machine(), PipelineConfig()), agent.bundles(WARM_S + FOLLOWED_S)
    for _ in range(WARM_S):
        pipeline.step(next(seconds))
    walks = [walked(partial(pipeline.step, [reading])) for bundle in seconds for reading in bundle]
    return counted(min((walk for walk in walks if FIX in walk), key=len))


def _questions(folder: Path, hours: float) -> Iterator[tuple[str, Figures]]:
    """Walk of each query, first of its kind; new samples precede the point on fresh ground."""
    rows, work = samples_of(hours) // BATCH, batches()
    write_store(folder, SITE, rows, tail_rows=0)
    sent = list(islice(work, rows))
    machine, last = sent[-1]
    x_m, y_m = (float(last[name][-1]) for name in ("x_m", "y_m"))
    store = Store(JournalLocation(folder), SITE, ServerConfig(), lambda: int(last["stamp_ns"][-1]))
    with closing(Writer(store)) as writer:
        past = StorePast.of_store(folder, SITE.cell_m, writer.config.fold)
        source = ServerSource(writer, cast(Upkeep, None), past)  # unused by these queries
        point = PointQuery(x_m, y_m)
        Answers(source).answer(point)  # settles the ground; each query then has its own cache
        questions: dict[str, MapQuery[Any]] = {
            "point, settled": point,
            "why": WhyQuery(x_m, y_m),
            "worklist": WorklistQuery(after=rows),
        }
        for name, question in questions.items():
            answers = Answers(source)
            yield name, counted(walked(partial(answers.answer, question)))
        answers.answer(point)
        yield "point, kept", counted(walked(partial(answers.answer, point)))
        acknowledged = threading.Event()
        batch = encode_batch(SampleBatch(machine, 2, 1, last, SITE.frame))
        writer.submit(Incoming(machine, batch), lambda _: acknowledged.set())
        acknowledged.wait()
        yield "point, fresh ground", counted(walked(partial(answers.answer, point)))
