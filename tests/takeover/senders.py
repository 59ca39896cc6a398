"""Machines without spool that record every acknowledgement."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import zenoh

from protocol.arrays import Table
from protocol.machine.samples import empty
from protocol.site.site_config import SiteConfig
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, SampleBatch
from tests.patience import PATIENCE_S

BATCH = 10
SPOOL = 7
ANSWER_S = 0.5
BEGIN_NS = 1_767_225_600_000_000_000


@dataclass(frozen=True)
class Acknowledged:
    """An acknowledgement as received. at_s: this host's clock."""

    machine: str
    watermark: int
    row: int
    epoch: int
    store: str
    at_s: float


class Sender(threading.Thread):
    """Sends samples 1, 2, 3... of one machine, each until acknowledged. audit: a line per acknowledgement."""

    def __init__(self, session: zenoh.Session, site: SiteConfig, machine: str, audit: Path, pause_s: float) -> None:
        super().__init__(name=machine, daemon=True)
        self.machine, self.reached = machine, 0
        self.acknowledged: list[Acknowledged] = []
        self.refused: list[str] = []
        self._session, self._site, self._audit, self._pause_s = session, site, audit, pause_s
        self._ending = threading.Event()

    def end(self) -> None:
        self._ending.set()
        self.join(PATIENCE_S)

    def run(self) -> None:
        with self._audit.open("a") as audit:
            while not self._ending.is_set():
                rows = rows_of(self.reached + 1, BATCH)
                batch = SampleBatch(self.machine, SPOOL, self.reached + 1, rows, self._site.frame)
                if ack := self._ask(encode_batch(batch)):
                    self.reached = ack.watermark
                    seen = Acknowledged(self.machine, ack.watermark, ack.row, ack.epoch, ack.store, time.time())
                    audit.write(json.dumps(asdict(seen)) + "\n")
                    audit.flush()
                    self.acknowledged.append(seen)
                self._ending.wait(self._pause_s)

    def _ask(self, payload: bytes) -> Ack | None:
        try:
            replies = self._session.get(keys.ingest(self._site.name, self.machine), payload=payload, timeout=ANSWER_S)
            for reply in replies:
                answer = decode_reply(reply.ok.payload.to_bytes()) if reply.ok else None
                if isinstance(answer, Ack):
                    return answer
                if answer:
                    self.refused.append(answer.reason)
        except zenoh.ZError as error:
            self.refused.append(str(error))
        return None


def rows_of(first_seq: int, count: int) -> Table:
    """Samples by number, reproducible."""
    seqs = first_seq + np.arange(count)
    rows = empty(count)
    usual = {"distance_m": 1.0, "c_rr": 0.04, "grade_e": 0.1, "grade_n": -0.05, "cov_xx_m2": 0.01, "cov_yy_m2": 0.01}
    placed = {"stamp_ns": BEGIN_NS + seqs * 100_000_000, "x_m": seqs % 400 + 0.5, "y_m": (seqs // 400) % 400 + 0.5}
    for name, values in (usual | placed).items():
        rows[name] = values
    return rows
