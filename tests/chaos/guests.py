"""Machines without process: they send synthetic samples and record acknowledgements like agents."""

from __future__ import annotations

import numpy as np

from agents.delivery.audit import AuditLog
from protocol.arrays import AnyArray, Table
from protocol.errors import LinkError
from protocol.machine.samples import empty
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Refused, SampleBatch
from protocol.wire.session import SessionConfig, open_session
from tests.chaos.chaos_site import RESUME_S, ROUTER, ChaosSite
from tests.chaos.recordings import START_NS


class Guest:
    """One guest; its audit file has acknowledged samples."""

    def __init__(self, site: ChaosSite, name: str) -> None:
        self.name = name
        self._site = load_site(site.folder / "site.toml")
        self._session = open_session(SessionConfig(site.endpoints[ROUTER]))
        self._audit, self._seq = AuditLog(site.folder / "audit" / name), 0
        site.guests += (name,)

    def send(self, rows: Table) -> str:
        """Send samples until taken or refused; returns the reason of refusal, or empty."""
        batch = SampleBatch(self.name, 1, self._seq + 1, rows, self._site.frame)
        key, data = keys.ingest(self._site.name, self.name), encode_batch(batch)
        for _ in range(round(RESUME_S)):
            for reply in self._session.get(key, payload=data, timeout=1.0):
                answer = decode_reply(reply.ok.payload.to_bytes()) if reply.ok else None
                if isinstance(answer, Refused) and not answer.retry_after_s:
                    return answer.reason
                if answer and not isinstance(answer, Refused):
                    self._audit.recorded(1, self._seq + 1, rows)
                    self._seq += len(rows)
                    return ""
        raise LinkError(key, "no answer")

    def close(self) -> None:
        self._session.close()  # type: ignore[no-untyped-call]
        self._audit.close()


def made_up(x_m: AnyArray, y_m: AnyArray, first_s: float, step_s: float, std_m: float, distance_m: float) -> Table:
    """Samples (n,) at places, with stated standard deviation and distance each."""
    rows = empty(len(x_m))
    rows["stamp_ns"] = START_NS + np.round((first_s + step_s * np.arange(len(x_m))) * 1e9).astype(np.int64)
    rows["x_m"], rows["y_m"], rows["distance_m"] = x_m, y_m, distance_m
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = std_m**2
    rows["speed_mps"], rows["c_rr"], rows["c_rr_var"], rows["grade_var"] = distance_m / step_s, 0.03, 1e-4, 1e-4
    return rows
