"""Change, trust and time through real processes: router, map server, commands."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from protocol.arrays import Table
from protocol.machine.samples import empty
from protocol.queries.requests import HistoryQuery, RegionQuery
from protocol.site.geometry import Bounds
from protocol.site.site_file import load_site
from protocol.wire import keys
from protocol.wire.codec import decode_reply, encode_batch
from protocol.wire.messages import Ack, SampleBatch
from sitegrid import Client
from sitegrid.process.children import Child
from tests.command_lines import said
from tests.integration.site_run import SiteRun, kill  # beside this file
from tests.patience import until

pytestmark = pytest.mark.processes

START_NS, HOUR_NS, SIZE = 1_767_225_600 * 10**9, 3600 * 10**9, 48
BAD, OLD, NEW = 1.6, 0.06, 0.02
CONFIG = "[store]\narchive_after_h = 0\n[trust]\njudge_s = 0.2\n[calibration]\nautomatic = false\n"


def sweep(seed: int, hour: float, gain: float = 1.0, *, repaved: bool = False) -> Table:
    """Every metre of three zones; the eastern one is wet dirt until repaved."""
    draw = np.random.default_rng(seed)
    x, y = (v.ravel() + 0.5 for v in np.meshgrid(np.arange(SIZE), np.arange(SIZE)))
    zone = np.array([0.008, 0.04, NEW if repaved else OLD])[(x * 3 // SIZE).astype(int)]
    rows = empty(len(x))
    rows["stamp_ns"] = START_NS + int(hour * HOUR_NS) + np.arange(len(x)) * 10**8
    rows["x_m"], rows["y_m"] = x + draw.normal(0, 0.3, len(x)), y + draw.normal(0, 0.3, len(x))
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = 0.09
    rows["distance_m"], rows["c_rr"], rows["c_rr_var"] = 1.0, gain * zone * draw.normal(1, 0.03, len(x)), 1e-6
    return rows


class Senders:
    """Machines sending batches in turn, a spool each."""

    def __init__(self, site_run: SiteRun, client: Client) -> None:
        self._client, self._site = client, load_site(site_run.site_file)
        self._next: dict[str, int] = {}

    def send(self, sent: dict[str, Table]) -> int:
        """Send all; returns the last journal row."""
        row = 0
        for parts in zip(*(np.array_split(rows, 10) for rows in sent.values()), strict=True):
            for name, part in zip(sent, parts, strict=True):
                first = self._next.get(name, 1)
                batch = SampleBatch(name, 7, first, part, self._site.frame)
                (reply,) = self._client.session.get(
                    keys.ingest(self._site.name, name), payload=encode_batch(batch), timeout=20.0
                )
                answer = decode_reply(reply.ok.payload.to_bytes())
                assert isinstance(answer, Ack), answer
                self._next[name], row = first + len(part), answer.row
        return row


@pytest.fixture
def server(site_run: SiteRun, tmp_path: Path) -> Iterator[Child]:
    (tmp_path / "server.toml").write_text(CONFIG)
    site_run.start_router()
    return site_run.start_server("--config", str(tmp_path / "server.toml"))


def resistance(client: Client, **when: Any) -> float:
    """Median inside the eastern zone."""
    bounds = Bounds(SIZE * 2 / 3 + 4, 4.0, SIZE - 4.0, SIZE - 4.0)
    region = client.ask(RegionQuery(bounds, ("resistance",), **when))
    return float(np.nanmedian(region["resistance"]))


def command(site_run: SiteRun, *words: str) -> Any:
    where = ("--endpoint", site_run.endpoint, "--site", site_run.site, "--json")
    return said(words[0], *where, *words[1:]).json


def test_a_repaved_zone_is_reported_dated_and_can_be_undone_in_time(site_run: SiteRun, server: Child):
    with site_run.connect() as client:
        events: list[Any] = []
        listener = client.on_change(events.append)
        senders = Senders(site_run, client)
        senders.send({"a": np.concatenate([sweep(1, 0), sweep(2, 1)])})
        before_ns = START_NS + 2 * HOUR_NS
        row = senders.send({"a": sweep(3, 3, repaved=True)})
        assert resistance(client, after=row) == pytest.approx(NEW, rel=0.1)
        assert resistance(client, as_of_ns=before_ns) == pytest.approx(OLD, rel=0.1)
        assert resistance(client, minus_ns=before_ns) == pytest.approx(NEW - OLD, rel=0.1)
        spans = client.ask(HistoryQuery(SIZE - 8.5, 20.5, ("resistance",), span_s=3600.0)).spans
        assert [round(span.values["resistance"], 2) for span in spans] == [OLD, OLD, NEW]
        until(lambda: events and client.changes()[0].cells > 400, f"a change of server pid {server.pid}")
        (change,) = client.changes()
        assert change.resistance_before == pytest.approx(OLD, rel=0.1)
        assert before_ns - HOUR_NS < change.first_ns < START_NS + 4 * HOUR_NS
        listener.close()
    assert command(site_run, "query", "changes")["changes"][0]["id"] == change.id


@pytest.mark.nightly
def test_a_bad_machine_is_found_left_out_and_stays_so_after_a_kill(site_run: SiteRun, server: Child, tmp_path: Path):
    with site_run.connect() as client:
        senders = Senders(site_run, client)
        good = {name: sweep(i, 0) for i, name in enumerate("abd")}
        senders.send({**good, "c": sweep(9, 0, BAD)})
        senders.send({**{n: sweep(i + 20, 3) for i, n in enumerate("abd")}, "c": sweep(29, 3, BAD)})
        until(lambda: client.info().distrusted == ("c",), f"server pid {server.pid} leaves out c")
        (machine,) = [machine for machine in client.machines() if machine.name == "c"]
        assert (machine.trusted, machine.by) == (False, "audit")
        assert "gain" in machine.reason
        assert machine.evidence["gain"] == pytest.approx(BAD, rel=0.15)
        assert resistance(client) == pytest.approx(OLD, rel=0.05)
        kill(server)
    site_run.start_server("--config", str(tmp_path / "server.toml"))
    with site_run.connect() as client:
        assert client.info().distrusted == ("c",)
        folded = client.info().samples_merged
        assert command(site_run, "trust", "c")["trusted"] is True
        assert client.info().samples_merged == folded * 4 // 3
        assert command(site_run, "distrust", "c", "--reason", "its scale is broken")["by"] == "person"
        assert client.info().samples_merged == folded
