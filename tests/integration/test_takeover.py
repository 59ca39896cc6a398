"""Take-over by a second server as processes; in full: `python -m tests.takeover --count 200`."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import pytest

from sitegrid import connect
from sitegrid.process.children import Children
from tests import postgres_server as server
from tests.patience import PATIENCE_S, until
from tests.postgres_server import Database
from tests.takeover.site import FENCED, SITE, TakeOverSite, kill, round_of, stop

pytestmark = pytest.mark.processes


@pytest.mark.nightly
def test_a_standby_takes_over_and_nothing_is_lost_double_or_acknowledged_under_an_old_epoch(
    tmp_path: Path, database: Database
) -> None:
    with Children(tmp_path) as children:
        site = TakeOverSite(tmp_path, children, database)
        site.start()
        rounds = []
        for fault in (kill, stop):
            serving = site.active.child.pid
            rounds.append(round_of(site, fault))
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
    assert set(site.exit_codes) <= {str(FENCED), "-9"}, "none ends for another reason"
    assert info.epoch >= epochs[-1]
    assert {ack.store for ack in site.acknowledged()} == {info.store}


@pytest.mark.nightly
def test_a_server_goes_on_at_the_promoted_replica_when_its_database_is_killed(tmp_path: Path) -> None:
    with server.cluster() as primary, server.replica(primary, "b") as replica, Children(tmp_path) as children:
        primary.sql("ALTER SYSTEM SET synchronous_standby_names = 'b'")
        primary.sql("SELECT pg_reload_conf()")
        in_step = "SELECT sync_state FROM pg_stat_replication"
        until(lambda: primary.sql(in_step) == [("sync",)], "the replica is synchronous")
        site = TakeOverSite(tmp_path, children, primary.new_database(), hosts=(primary, replica))
        site.start()
        site.wait_for_acknowledgements(20)
        epoch, began_s = site.epoch(), time.time()
        primary.stop(signal.SIGKILL)
        replica.promote()
        replica.sql("ALTER SYSTEM RESET synchronous_standby_names")  # alone by a person's decision
        replica.sql("SELECT pg_reload_conf()")
        took_s = site.wait_for_acknowledgements(beyond=epoch) - began_s
        site.wait_for_acknowledgements(20)
        for sender in site.senders:
            sender.end()
        site.database = Database(replica, site.database.name)
        verdict = site.verdict()
    print(f"first acknowledgement {took_s:.2f} s after the kill; {verdict}")
    assert verdict.is_clean, verdict


@pytest.mark.nightly
def test_of_two_servers_at_a_promoted_replica_and_at_the_old_primary_the_old_one_ends(tmp_path: Path) -> None:
    """The old primary lives and waits for no replica: both databases take commits."""
    with server.cluster() as primary, Children(tmp_path) as children:
        database = primary.new_database()
        with server.replica(primary, "b") as replica:
            site = TakeOverSite(tmp_path, children, database, hosts=(primary,))
            site.start()
            site.wait_for_acknowledgements(5)
            row = site.acknowledged()[-1].row
            until(lambda: replica.shows_all_of(primary), "the replica follows")
            last_row = Database(replica, database.name).sql("SELECT last_row FROM sitegrid.head")[0][0]
            assert last_row >= row
            for sender in site.senders:
                sender.end()
            assert site.standby
            site.standby.child.stop()
            replica.promote()
            site._hosts, old = (replica,), site.active
            new = site._server()
            new.child.expect("ready", PATIENCE_S)
            assert old.child.wait(PATIENCE_S) == FENCED
            assert "two databases have this journal" in (tmp_path / f"{old.name}.log").read_text()
            assert new.child.code is None, f"pids {old.child.pid}, {new.child.pid}"
            with connect(site.endpoint, SITE.name) as client:
                until(lambda: client.info().epoch == 2, "the one at the promoted replica serves")
            new.child.stop()
