"""A fleet with one broken machine at a real server's upkeep: samples in, calibration, trust and map out."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapserver.config import ServerConfig, StoreConfig, TrustConfig
from mapserver.ingest.writer import Writer
from mapserver.journal.facts import Facts
from mapserver.upkeep import upkeep
from mapserver.upkeep.upkeep import Upkeep
from protocol.arrays import Table
from tests.unit.mapserver.data import incoming, open_writer, past_of, send, wait_for
from tests.unit.mapserver.fleet.drives import LOW, RAMP, RAMP_AGAIN, Errors, drive

GAIN = 0.6
SENT = {
    "again": drive(RAMP_AGAIN, Errors(0.008, 0.03), seed=2),
    "bad": drive(RAMP, Errors(0.003, GAIN), seed=99),
    "low": drive(LOW, Errors(0.004, -0.05), seed=0),
    "ramp": drive(RAMP, Errors(-0.006, 0.04), seed=1),
}
CONFIG = ServerConfig(store=StoreConfig(archive_after_h=0.0), trust=TrustConfig(0.05))


def deliver(writer: Writer, sent: dict[str, Table], batch: int = 100) -> None:
    """Batches of all machines in turn, as they come in."""
    for first in range(0, max(map(len, sent.values())), batch):
        for name, rows in sent.items():
            if len(part := rows[first : first + batch]):
                send(writer, [incoming(part, first + 1, name)])


def seen(site: Upkeep) -> dict[str, Any]:
    """What the server says of the broken machine."""
    return next(each for each in site.machines() if each["name"] == "bad")


def facts_of(writer: Writer) -> Facts:
    """What the map is folded with."""
    return writer.run(lambda store: store.facts)


@pytest.mark.slow
def test_a_broken_machine_is_named_left_out_and_let_in_by_a_person(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(upkeep, "TURN_S", 0.01)
    writer = open_writer(tmp_path / "store", CONFIG)
    with closing(writer), closing(Upkeep(writer, lambda _: None, past_of(writer))) as site:
        deliver(writer, SENT)
        wait_for(lambda: facts_of(writer).excluded == {"bad"})
        row = seen(site)
        assert (row["trusted"], row["by"]) == (False, "audit")  # for its gain, where the audit was there first
        site.calibrate(20.0)
        before = facts_of(writer).corrections
        assert {one.machine for one in before.each} == set(SENT) - {"bad"}
        wait_for(lambda: seen(site)["evidence"]["gain"] == pytest.approx(1.0, abs=0.1))  # what is corrected agrees
        assert seen(site)["reasons"] == ["beyond_data_sheet"]
        assert seen(site)["evidence"]["torque_gain"] == pytest.approx(1 + GAIN, abs=0.05)
        row = site.trust("bad", True, "its torque is corrected", 20.0)
        assert (row["trusted"], row["by"], row["contradicts"]) == (True, "person", True)
        site.calibrate(20.0)
        own = [one for one in facts_of(writer).corrections.each if one.machine == "bad"]
        others = [one for one in facts_of(writer).corrections.each if one.machine != "bad"]
        assert others == list(before.each)  # in the map, but still without a say
        assert own[0].scale == pytest.approx(GAIN / (1 + GAIN), abs=0.02)
        read = writer.run(lambda store: store.grid.counts())
        assert read.folded == sum(map(len, SENT.values()))
        right = facts_of(writer).corrections.applied(SENT["bad"], ("bad",), np.zeros(len(SENT["bad"]), np.int64))
        true = drive(RAMP, Errors(), seed=99)
        assert abs(np.median(right["c_rr"] - true["c_rr"])) < 0.003
    again = open_writer(tmp_path / "store", CONFIG)
    with closing(again), closing(Upkeep(again, lambda _: None, past_of(again))) as site:
        wait_for(lambda: seen(site)["reasons"] == ["beyond_data_sheet"])  # before it has solved anything
        assert seen(site)["evidence"]["torque_gain"] == pytest.approx(1 + GAIN, abs=0.05)
