"""A second server takes over, as processes: the whole of it by `python -m tests.takeover --count 200`."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from benchmarks.postgres.server import Database
from sitegrid import connect
from sitegrid.process.children import Children
from tests.takeover.site import FENCED, SITE, TakeOverSite, cut_answer, kill, round_of, stop, terminate

pytestmark = pytest.mark.processes


def test_a_standby_takes_over_and_nothing_is_lost_double_or_acknowledged_under_an_old_epoch(
    tmp_path: Path, database: Database
) -> None:
    with Children(tmp_path) as children:
        site = TakeOverSite(tmp_path, children, database)
        site.start()
        rounds = []
        for fault in (kill, stop, cut_answer, terminate):
            serving = site.active.child.pid
            rounds.append(round_of(site, fault))
            if fault in (kill, stop):
                assert site.active.child.pid not in (serving, os.getpid())
        with connect(site.endpoint, SITE.name) as client:
            info = client.info()
        for sender in site.senders:
            sender.end()
        verdict = site.verdict()
    assert verdict.is_clean, verdict
    assert verdict.acknowledged > 20
    epochs = [one["epoch"] for one in rounds]
    assert epochs == sorted(set(epochs)), "each round has a new writer"
    assert site.exit_codes[str(FENCED)] >= 1, "the stopped one, once it went on"
    assert site.exit_codes["-9"] == 1
    assert info.epoch >= epochs[-1]
    assert {ack.store for ack in site.acknowledged()} == {info.store}
