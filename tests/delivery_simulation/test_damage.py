"""Repeated damage to logs of server and machines: all losses are declared."""

from __future__ import annotations

import random
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from agents.delivery.spool import Spool, SpoolConfig
from agents.delivery.uplink import Action, Pacing, Uplink, Wait
from agents.delivery.uplink_thread import perform
from mapserver.ingest.store import Incoming
from mapserver.journal.location import JOURNAL_FILE
from protocol.errors import StoreError
from protocol.machine.samples import empty
from protocol.site.site_config import SiteConfig
from protocol.wire.messages import Ack, Refused
from tests.chaos.damage_faults import flip
from tests.delivery_simulation.faults import FaultPlan
from tests.delivery_simulation.servers import RealServer

SITE = SiteConfig("lot", 49.01, 8.4, 120.0)
START_NS, STEPS, DAMAGES = 1_767_225_600_000_000_000, 200, 0.06
RunKey = tuple[str, int]


class Machine:
    """A spool with uplink. recorded: last seq by run."""

    def __init__(self, name: str, folder: Path, server: RealServer) -> None:
        self.name, self.path, self.recorded = name, folder / f"{name}.db", dict[RunKey, int]()
        self._server = server
        self.start()

    def start(self) -> None:
        self.spool = Spool(self.path, SpoolConfig())
        pacing, rng = Pacing(first_batch=20, max_batch=60), np.random.default_rng(0)
        self._uplink = Uplink(self.name, SITE.frame, 3.0, pacing, rng)

    def record(self, n: int, now_ns: int) -> None:
        rows = empty(n)
        rows["stamp_ns"], rows["c_rr"] = now_ns + np.arange(n), 0.05
        rows["cov_xx_m2"] = rows["cov_yy_m2"] = 1.0
        first = self.spool.record(rows)
        self.recorded[self.name, self.spool.spool_id] = first + n - 1

    def exchange(self) -> None:
        action: Action = self._uplink.start_exchange()
        while not isinstance(action, Wait):
            action = perform(action, self._uplink, self.spool, self._ask)

    def _ask(self, payload: bytes) -> tuple[Ack | Refused, float]:
        return self._server.take([Incoming(self.name, payload)], FaultPlan())[0], 0.1


def strike(path: Path, close: Callable[[], None], start: Callable[[], None], rng: random.Random) -> None:
    """Leave files like kill -9 with a flipped bit; restored if nobody starts with them."""
    left = {p: p.read_bytes() for p in path.parent.glob(f"{path.name}*") if not p.name.endswith("-shm")}

    def put() -> None:
        for file in path.parent.glob(f"{path.name}*"):
            file.unlink()
        for file, content in left.items():
            file.write_bytes(content)

    close()
    put()
    flip(path, rng)
    try:
        start()
    except StoreError as error:
        assert path.name in str(error)  # noqa: PT017 # most flips leave it usable
        put()
        start()


def deliver_all(machines: list[Machine]) -> None:
    """Until nothing waits, and again by restarted agents."""
    for machine in machines * 2:
        machine.spool.close()
        machine.start()
        while not machine.spool.is_settled():
            machine.exchange()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_whatever_damage_takes_is_declared_by_its_machine(seed: int, tmp_path: Path) -> None:
    rng, server = random.Random(seed), RealServer(tmp_path, SITE, lambda: START_NS + STEPS * 10**9)
    machines = [Machine(f"loader-{i}", tmp_path, server) for i in range(3)]
    with closing(server):
        for step in range(STEPS):
            machine = rng.choice(machines)
            machine.record(rng.randint(1, 8), START_NS + step * 10**9) if rng.random() < 0.6 else machine.exchange()
            if rng.random() < DAMAGES:
                of_server = tmp_path / "store" / JOURNAL_FILE, server.close, server.open
                strike(*rng.choice([of_server, (machine.path, machine.spool.close, machine.start)]), rng)
        deliver_all(machines)
        recorded = {key: seq for machine in machines for key, seq in machine.recorded.items()}
        there = [sample[:3] for sample in server.samples()]
        marks = server.marks()
        for machine in machines:
            machine.spool.close()
    assert len(set(there)) == len(there)
    for run, seq in recorded.items():
        present = sum(sample[:2] == run for sample in there)
        reached, lost = marks.get(run, (0, 0))
        assert (reached, present + lost) == (seq, seq), f"run {run[1]:x} of {run[0]}"
