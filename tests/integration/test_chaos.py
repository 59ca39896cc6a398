"""The fault suite in short, one run per fault; in full: `make chaos`."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.chaos import (
    damage_faults,
    disk_faults,
    pending_faults,
    reader_faults,
    site_faults,
    store_faults,
    visitor_faults,
)
from tests.chaos.disk_shim import build
from tests.chaos.outcome import Console, FaultOutcome
from tests.chaos.recordings import make
from tests.chaos.scenario import FaultRun
from tests.patience import PATIENCE_S, until

pytestmark = [pytest.mark.processes, pytest.mark.nightly]


@pytest.fixture
def library(tmp_path: Path) -> Path:
    if not (library := build(tmp_path)):
        pytest.skip("no C compiler for the shim")
    return library


def scenario(folder: Path, **options) -> FaultRun:
    values = {"fault": "short", "recordings": None, "seconds": 4.0, "scale": 0.02} | options
    return FaultRun(folder=folder, console=Console(line=lambda *_, **__: None), seed=3, **values)


def test_kills_of_agents_server_and_router_lose_nothing(tmp_path):
    recordings = make(tmp_path / "recordings", machines=2, seed=3, seconds=40)
    outcome = site_faults.kills(scenario(tmp_path / "run", recordings=recordings, strikes=4, seconds=2.0))
    assert (outcome.lost, outcome.double, outcome.problems) == (0, 0, [])
    assert outcome.count == 4
    assert outcome.recorded == outcome.merged > 30
    assert outcome.longest_pause_s is not None
    assert (outcome.declared, outcome.silent) == (0, 0)
    assert outcome.ack_ms_max is not None
    assert 0 < outcome.ack_ms_max < 60_000
    assert len(set(outcome.pids)) >= 4 + 4 + 2, "a process of its own for every start"
    assert not any(Path(f"/proc/{pid}").exists() for pid in outcome.pids)


@pytest.mark.parametrize("fault", [pending_faults.window, pending_faults.parked])
def test_samples_that_wait_for_the_smoother_outlive_kills_and_silence(tmp_path, fault):
    recordings = make(tmp_path / "recordings", machines=2, seed=3)
    outcome = fault(scenario(tmp_path / "run", recordings=recordings, strikes=1))
    assert (outcome.lost, outcome.double, outcome.declared, outcome.problems) == (0, 0, 0, [])
    assert outcome.recorded == outcome.merged > 2 * pending_faults.LEAST_PENDING


def harmless(tmp_path: Path, fault: Callable[[FaultRun], FaultOutcome]) -> FaultOutcome:
    """Outcome of a lossless fault on a site of two machines."""
    recordings = make(tmp_path / "recordings", machines=2, seed=3, seconds=80)
    outcome = fault(scenario(tmp_path / "run", recordings=recordings))
    assert (outcome.lost, outcome.double, outcome.silent, outcome.problems) == (0, 0, 0, [])
    assert outcome.merged + outcome.declared == outcome.recorded > 30
    return outcome


def test_a_second_map_server_takes_nothing_from_the_first(tmp_path):
    assert harmless(tmp_path, store_faults.second_server).declared == 0


def test_the_year_2099_shifts_no_clock_and_blocks_no_spool(tmp_path):
    outcome = harmless(tmp_path, store_faults.far_future)
    assert outcome.declared == outcome.notes["quarantined"] > 0


def test_the_archive_goes_on_after_a_wrong_clock(tmp_path):
    outcome = harmless(tmp_path, store_faults.archive_clock)
    assert (outcome.declared, outcome.notes["archived"] > 0) == (0, True)


@pytest.mark.parametrize("fault", [damage_faults.wal_flip, damage_faults.restored_store])
def test_what_damage_takes_is_declared_and_named(tmp_path, fault):
    recordings = make(tmp_path / "recordings", machines=2, seed=3, seconds=80)
    outcome = fault(scenario(tmp_path / "run", recordings=recordings, seconds=3.0))
    assert (outcome.lost, outcome.double, outcome.silent, outcome.problems) == (0, 0, 0, [])
    assert outcome.declared > 0
    assert outcome.recorded == outcome.merged + outcome.declared


def test_agents_name_a_damaged_calibration_and_go_on(tmp_path):
    recordings = make(tmp_path / "recordings", machines=1, seed=3, seconds=40)
    outcome = damage_faults.calibration_flip(scenario(tmp_path / "run", recordings=recordings, seconds=1.0))
    assert (outcome.lost, outcome.silent, outcome.problems) == (0, 0, [])
    assert outcome.count > 1000


@pytest.mark.skipif(sys.platform != "linux", reason="/proc")
def test_readers_that_sleep_cost_machines_nothing(tmp_path):
    recordings = make(tmp_path / "recordings", machines=2, seed=3, seconds=60)
    outcome = reader_faults.sleeping_reader(scenario(tmp_path / "run", recordings=recordings, seconds=1.0))
    assert outcome.problems == [], "among others: a slow acknowledgement, a server that took more memory"
    assert outcome.is_good
    assert outcome.count == sum(readers for _, readers in reader_faults.SLEEPING)
    assert outcome.recorded == outcome.merged > 30
    assert 0 < outcome.ack_ms_max <= reader_faults.LONGEST_ACK_MS
    assert 0.9 < outcome.memory_ratio <= reader_faults.MOST_MEMORY
    assert outcome.answer_s_max > 0


@pytest.mark.skipif(sys.platform != "linux", reason="/proc, addresses of loopback")
@pytest.mark.parametrize("fault", [visitor_faults.visitors, visitor_faults.scatter, reader_faults.questions])
def test_strangers_take_no_more_than_their_share(tmp_path, fault):
    recordings = make(tmp_path / "recordings", machines=2, seed=3, seconds=60)
    outcome = fault(scenario(tmp_path / "run", recordings=recordings, seconds=1.0))
    assert outcome.problems == [], "among others: machines that are not served, a server that took more memory"
    assert (outcome.lost, outcome.double, outcome.silent) == (0, 0, 0)
    assert outcome.recorded == outcome.merged > 30
    assert outcome.count > 0


@pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD")
def test_power_cuts_lose_nothing_that_was_promised(tmp_path, library):
    outcome = disk_faults.power(scenario(tmp_path / "run", strikes=40))
    assert (outcome.count, outcome.lost, outcome.double, outcome.problems) == (40, 0, 0, [])
    assert outcome.recorded == outcome.merged > 1000


@pytest.mark.parametrize("what", ["spool", "store"])
def test_power_cuts_find_a_file_that_is_not_synced_at_every_commit(tmp_path, library, what):
    operations = disk_faults.trace(library, tmp_path / "run", what, 3, "careless")
    assert disk_faults.cut(operations, what, 20, random.Random(1)).lost > 0


def test_power_cuts_find_a_mark_that_is_written_before_its_commit(tmp_path, library):
    operations = disk_faults.trace(library, tmp_path / "run", "store", 3, "hasty")
    outcome = disk_faults.cut(operations, "store", 60, random.Random(1))
    assert any("false alarm" in problem for problem in outcome.problems)


def test_writes_that_fail_one_after_the_other_lose_nothing(tmp_path, library):
    outcome = disk_faults.writes(scenario(tmp_path / "run", scale=0.05))
    assert (outcome.lost, outcome.double, outcome.problems) == (0, 0, [])
    assert outcome.count > 10


def test_an_interrupted_suite_ends_everything(tmp_path):
    work = tmp_path / "work"
    words = [sys.executable, "-X", "faulthandler", "-m", "tests.chaos", "--faults", "freezes", "--keep", str(work)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ) as suite:
        until(lambda: len(list(work.glob("freezes/log/*.out"))) >= 3, "processes of the suite")
        suite.send_signal(signal.SIGINT)
        try:
            said, _ = suite.communicate(timeout=PATIENCE_S)
        except subprocess.TimeoutExpired:
            suite.send_signal(signal.SIGABRT)  # prints where it hangs
            raise
        assert said.splitlines()[-1] == "interrupted; everything is ended"
        assert suite.returncode == 130
    assert not _commands_with(str(work))


def _commands_with(text: str) -> list[str]:
    lines = (path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists())
    return [line.decode() for line in lines if text.encode() in line]
