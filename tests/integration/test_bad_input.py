"""Bad input to real processes: one counted refusal, a clear error, an untouched journal, continued service."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from mapserver.query.queryable import ANSWERED
from protocol.errors import Refusal
from protocol.machine.samples import SAMPLE_DTYPE, empty
from protocol.queries.answer_codec import decode_error
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import MAX_BATCH_BYTES, decode_health, decode_reply, encode_batch
from protocol.wire.messages import Ack, Refused, SampleBatch
from protocol.wire.session import SessionConfig, free_endpoint, open_session
from sim.config import SimConfig
from tests.integration.forks import Forks
from tests.integration.site_run import NOBODY_DRIVES, SiteRun  # beside this file
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.processes

NOW_NS = 1_767_225_600_000_000_000
MACHINE = "probe"
UNCHANGED = ("journalled", "merged", "samples_merged", "cells", "stamp_ns", "machines")  # by refusals


class Probe:
    """Router and server, with a session for arbitrary input."""

    def __init__(self, run: SiteRun) -> None:
        self.router, self.server, self.run = run.start_router(), run.start_server(), run
        self.site = load_site(run.site_file)
        self.session: zenoh.Session = open_session(SessionConfig(run.endpoint))
        self.client = run.connect()
        self.where = f"router {self.router.pid}, server {self.server.pid}"
        self.seq = 0

    def close(self) -> None:
        self.client.close()
        self.session.close()

    def send(self, payload: bytes | None, key: str = "") -> Ack | Refused:
        key = key or keys.ingest(self.site.name, MACHINE)
        answers = [reply.ok for reply in self.session.get(key, payload=payload, timeout=60.0)]
        assert [ok is not None for ok in answers] == [True], f"one answer is expected: {self.where}"
        return decode_reply(answers[0].payload.to_bytes())

    def batch(self, n: int = 3, **over: Any) -> SampleBatch:
        columns = {name: over.pop(name) for name in list(over) if name in SAMPLE_DTYPE.names}
        rows = empty(n)
        rows["stamp_ns"] = NOW_NS + np.arange(n) * 10**9
        rows["distance_m"], rows["c_rr"], rows["cov_xx_m2"], rows["cov_yy_m2"] = 1.0, 0.04, 1.0, 1.0
        for name, value in columns.items():
            rows[name][-1] = value
        fields = {"machine": MACHINE, "spool_id": 7, "first_seq": self.seq + 1, "frame": self.site.frame}
        return SampleBatch(rows=rows, **{**fields, **over})

    def takes_a_good_one(self) -> None:
        reply = self.send(encode_batch(self.batch()))
        assert isinstance(reply, Ack), f"{reply}: {self.where}"
        self.seq = reply.watermark


@pytest.fixture(scope="module")
def probe(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Probe]:
    folder = tmp_path_factory.mktemp("bad-input")
    with Forks(folder) as children:
        sim = NOBODY_DRIVES
        opened = Probe(SiteRun(folder, children, free_endpoint(), sim))
        opened.takes_a_good_one()
        yield opened
        opened.close()


def edited(probe: Probe, **fields: Any) -> bytes:
    """A valid batch with changed fields; None removes one."""
    table = {**msgpack.unpackb(encode_batch(probe.batch())), **fields}
    return bytes(msgpack.packb({name: value for name, value in table.items() if value is not None}))


def with_column(probe: Probe, name: str, value: Any) -> bytes:
    return edited(probe, cols={**msgpack.unpackb(encode_batch(probe.batch()))["cols"], name: value})


BAD_BATCHES = {
    "nan position": (lambda p: encode_batch(p.batch(x_m=np.nan)), Refusal.NOT_FINITE, "x_m[2]"),
    "a position that jumps": (lambda p: encode_batch(p.batch(y_m=9e6)), Refusal.OUTSIDE_SITE, "y_m[2]"),
    "oversize": (lambda p: bytes(MAX_BATCH_BYTES + 1), Refusal.TOO_LARGE, "4194305 bytes"),
    "deep nesting": (lambda p: b"\x81\xa1v" + b"\x91" * 100_000, Refusal.NOT_MSGPACK, "not MessagePack"),
    "wrong type": (lambda p: edited(p, first_seq="1"), Refusal.WRONG_TYPE, "first_seq"),
    "column cut": (lambda p: with_column(p, "x_m", bytes(17)), Refusal.COLUMN_LENGTH, "cols.x_m"),
    "unknown version": (lambda p: edited(p, v=2), Refusal.VERSION, "v: 2"),
    "sequence ahead": (lambda p: edited(p, first_seq=900), Refusal.GAP, "first_seq: 900"),
    "more lost than before it": (lambda p: edited(p, lost_before=900), Refusal.OUT_OF_RANGE, "lost_before"),
    "another machine": (lambda p: edited(p, machine="loader-1"), Refusal.WRONG_MACHINE, "machine"),
    "another frame": (lambda p: edited(p, frame="00000000"), Refusal.WRONG_FRAME, "frame"),
    "no payload": (lambda p: None, Refusal.NOT_MSGPACK, "not MessagePack"),
}


@pytest.mark.parametrize("name", BAD_BATCHES)
def test_a_bad_batch_is_refused_counted_and_leaves_no_trace(probe: Probe, name: str):
    make, reason, problem = BAD_BATCHES[name]
    probe.client.point(1.0, 1.0)  # folds and counts earlier samples
    before = probe.client.info()
    reply = probe.send(make(probe))
    assert isinstance(reply, Refused), f"{reply}: {probe.where}"
    assert (reply.reason, reply.problem[: len(problem)]) == (reason, problem), probe.where
    assert reply.problem.isprintable()
    after = probe.client.info()
    changed = {k: n - before.counters.get(k, 0) for k, n in after.counters.items() if k != ANSWERED}
    assert {k: n for k, n in changed.items() if n} == {f"refused_{reason}": 1}, probe.where
    assert [getattr(after, name) for name in UNCHANGED] == [getattr(before, name) for name in UNCHANGED], probe.where
    probe.takes_a_good_one()
    assert probe.client.info().journalled == before.journalled + 1


def test_a_key_with_a_wildcard_names_no_machine(probe: Probe):
    before = probe.client.info()
    reply = probe.send(encode_batch(probe.batch()), f"sitegrid/{probe.site.name}/ingest/*")
    assert isinstance(reply, Refused)
    assert reply.reason == Refusal.WRONG_MACHINE, probe.where
    assert probe.client.info().journalled == before.journalled


BAD_QUERIES = {
    "map/point?x=nan;y=1": Refusal.NOT_FINITE,
    "map/point?x=1;y=1;z=1": Refusal.UNKNOWN_PARAMETER,
    "map/point?x=1;y=1;layers=gold": Refusal.UNKNOWN_LAYER,
    "map/region?bounds=-1e14,-1e14,1e14,1e14": Refusal.TOO_LARGE,
    "map/region?polygon=0,0,9,9,9,0,0,9": Refusal.OUT_OF_RANGE,
    "map/region?bounds=0,0,9,9;resolution=2.5": Refusal.OUT_OF_RANGE,
    "map/region?bounds=0,0,9,9;resolution=2;layers=heading": Refusal.OUT_OF_RANGE,
    "map/route?line=0,0,9,9;machine=nobody": Refusal.OUT_OF_RANGE,
    "map/history?x=1;y=1;from=1;to=4102444800000000000;span=1": Refusal.TOO_LARGE,
    "map/info?after=99999;wait=0": Refusal.AFTER_TIMEOUT,
    "map/gold": Refusal.UNKNOWN_QUERY,
    "admin/trust?machine=probe;trusted=maybe": Refusal.OUT_OF_RANGE,
    "admin/trust?machine=nobody;trusted=yes": Refusal.UNKNOWN_MACHINE,
}


@pytest.mark.parametrize("selector", BAD_QUERIES)
def test_a_bad_query_is_refused_counted_and_named(probe: Probe, selector: str):
    before = probe.client.info()
    replies = list(probe.session.get(f"sitegrid/{probe.site.name}/{selector}", timeout=60.0))
    assert [reply.err is not None for reply in replies] == [True], probe.where
    error = decode_error(replies[0].err.payload.to_bytes())
    assert error.reason == BAD_QUERIES[selector], f"{error}: {probe.where}"
    assert str(error).isprintable()
    after = probe.client.info()
    name = f"refused_query_{error.reason}"
    assert after.counters[name] - before.counters.get(name, 0) == 1, probe.where
    assert after.journalled == before.journalled
    assert probe.server.code is None, probe.where


@pytest.mark.nightly
def test_a_sample_that_is_never_taken_is_put_aside_reported_and_passed(children: Forks, tmp_path):
    """Samples beyond the server's smaller site are refused, later ones arrive."""
    sim = SimConfig(machines=1, seconds=60, speed=10, seed=3, world="fast")
    run = SiteRun(tmp_path, children, free_endpoint(), sim)
    wide = run.site_file.read_text()
    lines = [line for line in wide.splitlines() if not line.startswith("extent_m")]
    router = run.start_router()
    # Half of a recorded drive lies within the median.
    children.start("record", "sim", "--record", tmp_path / "logs", *words(sim)).wait(PATIENCE_S)
    extent_m = middle_of(tmp_path / "logs" / "loader-1", run)
    run.site_file.write_text("\n".join([f"extent_m = {extent_m}", *lines]) + "\n")
    server = run.start_server()
    run.site_file.write_text(wide)
    session = open_session(SessionConfig(run.endpoint))
    reports: list[bytes] = []
    session.declare_subscriber(keys.health(run.site, "loader-1"), lambda s: reports.append(s.payload.to_bytes()))
    agent = run.start_agent(run.configs[0])
    run.start_sim()
    where = f"router {router.pid}, server {server.pid}, agent {agent.pid}"
    report = agent.expect("ended", PATIENCE_S)["ended"]
    quarantined = report["spool"]["put_aside"]
    assert report["delivered"], where
    assert 0 < quarantined < report["samples"], where
    assert report["uplink"]["counters"]["refused_outside_site"] >= quarantined, where
    until(lambda: decode_health(reports[-1]).values["spool"]["put_aside"] == quarantined, "health says so")
    session.close()
    with run.connect() as client:
        info = client.info()
    sent = info.machines["loader-1"]
    assert (sent.samples, sent.samples + quarantined) == (info.samples_merged, report["samples"]), where
    assert 0 < sent.lost <= quarantined, f"declared lost, those before the last that was taken: {where}"


def words(sim: SimConfig) -> list[str]:
    names = ("seconds", "machines", "seed", "world")
    return [word for name in names for word in (f"--{name}", str(getattr(sim, name)))]


def middle_of(log: Any, run: SiteRun) -> float:
    """Extent of about half a recorded drive [m]."""
    from protocol.machine.log_folder import open_log
    from protocol.machine.readings import Gps
    from protocol.site.site_config import Projection

    to_map = Projection(load_site(run.site_file)).to_map
    fixes = [r for r in open_log(log).readings() if isinstance(r, Gps)]
    places = [to_map(fix.lat_deg, fix.lon_deg, fix.height_m)[:2] for fix in fixes]
    return float(np.median(np.abs(places).max(axis=1)))
