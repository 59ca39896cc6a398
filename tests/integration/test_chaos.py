"""The fault suite in short, and the proof that it would see a loss."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from agents.delivery.spool import Spool, SpoolConfig
from protocol.machine.samples import empty
from sitegrid.process.children import wait_until
from tests.chaos import __main__ as command
from tests.chaos import (
    bit_flips,
    damage_faults,
    disk_faults,
    pending_faults,
    reader_faults,
    site_faults,
    stepped_clock,
    store_faults,
)
from tests.chaos.__main__ import ChaosFault, run_suite, totals
from tests.chaos.disk_model import Disk, Kind, Operation
from tests.chaos.disk_shim import build
from tests.chaos.outcome import Console, FaultOutcome, longest_pause, table
from tests.chaos.recordings import make
from tests.chaos.scenario import FaultRun
from tests.tcp_proxy import FAIR, Proxy, Weather


@pytest.fixture
def library(tmp_path: Path) -> Path:
    if not (library := build(tmp_path)):
        pytest.skip("no C compiler for the shim")
    return library


def scenario(folder: Path, **options) -> FaultRun:
    values = {"fault": "short", "recordings": None, "seconds": 4.0, "scale": 0.02} | options
    return FaultRun(folder=folder, console=Console(line=lambda *_, **__: None), seed=3, **values)


@pytest.mark.processes
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


@pytest.mark.processes
@pytest.mark.parametrize("fault", [pending_faults.window, pending_faults.parked])
def test_samples_that_wait_for_the_smoother_outlive_kills_and_silence(tmp_path, fault):
    recordings = make(tmp_path / "recordings", machines=2, seed=3)
    outcome = fault(scenario(tmp_path / "run", recordings=recordings, strikes=1))
    assert (outcome.lost, outcome.double, outcome.declared, outcome.problems) == (0, 0, 0, [])
    assert outcome.recorded == outcome.merged > 2 * pending_faults.LEAST_PENDING


def harmless(tmp_path: Path, fault: Callable[[FaultRun], FaultOutcome]) -> FaultOutcome:
    """The outcome of a fault that strikes a site of two machines and takes nothing."""
    recordings = make(tmp_path / "recordings", machines=2, seed=3, seconds=80)
    outcome = fault(scenario(tmp_path / "run", recordings=recordings))
    assert (outcome.lost, outcome.double, outcome.silent, outcome.problems) == (0, 0, 0, [])
    assert outcome.merged + outcome.declared == outcome.recorded > 30
    return outcome


@pytest.mark.processes
def test_a_second_map_server_takes_nothing_from_the_first(tmp_path):
    assert harmless(tmp_path, store_faults.second_server).declared == 0


@pytest.mark.processes
def test_the_year_2099_shifts_no_clock_and_blocks_no_spool(tmp_path):
    outcome = harmless(tmp_path, store_faults.far_future)
    assert outcome.declared == outcome.notes["quarantined"] > 0


@pytest.mark.processes
def test_the_archive_goes_on_after_a_wrong_clock(tmp_path):
    outcome = harmless(tmp_path, store_faults.archive_clock)
    assert (outcome.declared, outcome.notes["archived"] > 0) == (0, True)


@pytest.mark.processes
@pytest.mark.parametrize("fault", [damage_faults.wal_flip, damage_faults.restored_store])
def test_what_damage_takes_is_declared_and_named(tmp_path, fault):
    recordings = make(tmp_path / "recordings", machines=2, seed=3, seconds=80)
    outcome = fault(scenario(tmp_path / "run", recordings=recordings, seconds=3.0))
    assert (outcome.lost, outcome.double, outcome.silent, outcome.problems) == (0, 0, 0, [])
    assert outcome.declared > 0
    assert outcome.recorded == outcome.merged + outcome.declared


@pytest.mark.processes
def test_agents_name_a_damaged_calibration_and_go_on(tmp_path):
    recordings = make(tmp_path / "recordings", machines=1, seed=3, seconds=40)
    outcome = damage_faults.calibration_flip(scenario(tmp_path / "run", recordings=recordings, seconds=1.0))
    assert (outcome.lost, outcome.silent, outcome.problems) == (0, 0, [])
    assert outcome.count > 1000


@pytest.mark.processes
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


@pytest.mark.processes
@pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD")
def test_power_cuts_lose_nothing_that_was_promised(tmp_path, library):
    outcome = disk_faults.power(scenario(tmp_path / "run", strikes=40))
    assert (outcome.count, outcome.lost, outcome.double, outcome.problems) == (40, 0, 0, [])
    assert outcome.recorded == outcome.merged > 1000


@pytest.mark.processes
@pytest.mark.parametrize("what", ["spool", "store"])
def test_power_cuts_find_a_file_that_is_not_synced_at_every_commit(tmp_path, library, what):
    operations = disk_faults.trace(library, tmp_path / "run", what, 3, "careless")
    assert disk_faults.cut(operations, what, 20, random.Random(1)).lost > 0


@pytest.mark.processes
def test_power_cuts_find_a_mark_that_is_written_before_its_commit(tmp_path, library):
    operations = disk_faults.trace(library, tmp_path / "run", "store", 3, "hasty")
    outcome = disk_faults.cut(operations, "store", 60, random.Random(1))
    assert any("false alarm" in problem for problem in outcome.problems)


@pytest.mark.processes
def test_writes_that_fail_one_after_the_other_lose_nothing(tmp_path, library):
    outcome = disk_faults.writes(scenario(tmp_path / "run", scale=0.05))
    assert (outcome.lost, outcome.double, outcome.problems) == (0, 0, [])
    assert outcome.count > 10


def test_a_power_cut_keeps_what_was_synced_and_may_drop_the_rest(tmp_path):
    disk, texts = Disk(), set()
    for kind, offset, data in (
        (Kind.CREATE, 0, b""),
        (Kind.WRITE, 0, b"a" * 1024),
        (Kind.SYNC, 0, b""),
        (Kind.WRITE, 0, b"b" * 1024),
        (Kind.TRUNCATE, 512, b""),
    ):
        disk.do(Operation(kind, "file", offset, data))
    for seed in range(60):
        disk.cut(random.Random(seed), tmp_path)
        texts.add((tmp_path / "file").read_bytes())
    a, b = b"a" * 512, b"b" * 512
    assert {a + a, b + b, a + b, b + a, a, b} >= texts >= {a + a, a + b, b}


def test_names_come_in_order_and_any_sync_makes_them_durable(tmp_path):
    disk, listings = Disk(), set()
    disk.do(Operation(Kind.CREATE, "new", 0, b""))
    disk.do(Operation(Kind.RENAME, "new", 0, b"named"))
    for seed in range(30):
        folder = tmp_path / str(seed)
        folder.mkdir()
        disk.cut(random.Random(seed), folder)
        listings.add(tuple(path.name for path in folder.iterdir()))
    assert listings == {(), ("new",), ("named",)}
    disk.do(Operation(Kind.SYNC, "named", 0, b""))
    disk.cut(random.Random(1), tmp_path)
    assert (tmp_path / "named").exists()


def test_a_flipped_bit_that_is_served_is_called_so(tmp_path):
    path, truth = tmp_path / "file", {"rows": 1}
    path.write_bytes(bytes(100))
    bit_flips.flip(path, random.Random(1), [7])
    changed = path.read_bytes()
    assert changed[7].bit_count() == 1
    assert sum(changed) == changed[7]
    assert bit_flips.judge(path, lambda _: {"rows": 2}, truth)[0] == bit_flips.FlipVerdict.SERVED
    assert bit_flips.judge(path, lambda _: {"rows": 1}, truth)[0] == bit_flips.FlipVerdict.HARMLESS
    assert bit_flips.judge(path, lambda _: [][0], truth) == (bit_flips.FlipVerdict.UNNAMED, "IndexError")


def test_a_spool_whose_header_is_damaged_is_detected(tmp_path):
    spool = Spool(tmp_path / "spool.db", SpoolConfig())
    spool.record(empty(3))
    spool.close()
    truth = bit_flips.read_spool(tmp_path / "spool.db")
    assert len(truth["contents"]) == 3
    bit_flips.flip(tmp_path / "spool.db", random.Random(1), [0])
    verdict, _ = bit_flips.judge(tmp_path / "spool.db", bit_flips.read_spool, truth)
    assert verdict == bit_flips.FlipVerdict.DETECTED


def test_the_proxy_forwards_holds_and_cuts():
    before = threading.active_count()
    with socket.create_server(("127.0.0.1", 0)) as far, Proxy(far.getsockname()[1]) as proxy:
        host, port = proxy.endpoint.removeprefix("tcp/").split(":")
        with socket.create_connection((host, int(port)), timeout=5.0) as near:
            there, _ = far.accept()
            near.sendall(b"there")
            assert there.recv(10) == b"there"
            proxy.set(Weather(hold_back=True))
            there.sendall(b"late")
            near.settimeout(0.1)
            with pytest.raises(TimeoutError):
                near.recv(10)
            proxy.set(FAIR)
            near.settimeout(5.0)
            assert near.recv(10) == b"late"
            proxy.set(Weather(cut=True))
            assert near.recv(10) == b""
            there.close()
    wait_until(lambda: threading.active_count() <= before, 5.0, "no thread of the proxy is left")


@pytest.mark.processes
def test_the_wall_clock_of_a_child_is_stepped_and_its_waits_are_not(tmp_path):
    stepped_clock.write(tmp_path / "clock", -3600 * 10**9)
    code = (
        "import sys, time; from pathlib import Path; from tests.chaos import stepped_clock as s;"
        "true, start = time.time(), time.monotonic(); s._step_clocks(Path(sys.argv[1])); time.sleep(0.01);"
        "print(round(time.time() - true), time.monotonic() - start < 5, time.time_ns() < true * 1e9)"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "clock")]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout.split() == ["-3600", "True", "True"]


def test_a_pause_leaves_out_what_the_fault_lasted():
    commits = [0.0, 1.0, 9.0, 10.0]
    assert longest_pause(commits, [], 11.0) == 8.0
    assert longest_pause(commits, [(2.0, 7.0)], 11.0) == 3.0
    assert longest_pause(commits, [(2.0, 5.0), (4.0, 7.0)], 11.0) == 3.0
    assert longest_pause(commits, [(0.0, 9.0)], 15.0) == 5.0


def test_the_order_of_kills_comes_from_the_seed(tmp_path):
    drawn = [site_faults.draw_kills(scenario(tmp_path).rng, ("a", "b"), 200, 60.0) for _ in range(2)]
    assert drawn[0] == drawn[1]
    assert sum(pause for pause, _ in drawn[0]) == pytest.approx(60.0)
    assert {victim for _, victim in drawn[0]} == {"a", "b", "router", "server"}


def test_a_loss_fails_the_suite_and_an_error_in_one_fault_lets_the_others_run(tmp_path, monkeypatch, capsys):
    def breaks(_: FaultRun) -> FaultOutcome:
        raise RuntimeError("broke")

    faults = (
        ChaosFault(
            "kills", lambda s: FaultOutcome("kills", count=7, recorded=9, merged=8, lost=1, silent=1, ack_ms_max=40)
        ),
        ChaosFault("power", breaks),
        ChaosFault("cable", lambda s: FaultOutcome("cable", skipped="not permitted")),
    )
    monkeypatch.setattr(command, "run_suite", lambda _, *rest: run_suite(faults, *rest))
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr("logging.disable", lambda: None)
    monkeypatch.setattr(command, "make", lambda *_, **__: None)
    assert command.main(["--json", "--seconds", "1"]) == 1
    lines = capsys.readouterr().out.splitlines()
    result = json.loads(lines[-1])
    assert result | {"kills": 7, "recorded": 9, "merged": 8, "lost": 1, "double": 0, "ok": False} == result
    assert result | {"declared": 0, "silent": 1, "ack_ms_max": 40} == result
    assert "RuntimeError: broke" in result["faults"][1]["problems"][0]
    assert any("skipped: not permitted" in line for line in lines)


def test_a_skipped_fault_is_no_failure():
    outcomes = [FaultOutcome("kills", count=1), FaultOutcome("cable", skipped="not permitted")]
    assert totals(outcomes, 1)["ok"]
    assert totals(outcomes, 1)["ack_ms_max"] == 0
    assert table(outcomes).splitlines()[1].endswith("ok")


def test_a_loss_that_was_named_fails_the_suite_and_is_not_silent():
    outcome = FaultOutcome("restored_store", recorded=9, merged=8, lost=1, named=1)
    assert not outcome.is_good
    header, row = (line.split()[:9] for line in table([outcome]).splitlines())
    shown = dict(zip(header, row, strict=True))
    assert [shown[name] for name in ("declared", "lost", "named", "silent")] == ["0", "1", "1", "0"]


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (["--faults", "kills,gold"], "no fault `gold`"),
        (["--seconds", "0"], "between 0 and 3600"),
        (["--keep", "."], "exists already"),
    ],
)
def test_options_that_make_no_sense_are_refused(words, problem, capsys):
    with pytest.raises(SystemExit, match="2"):
        command.main(words)
    assert problem in capsys.readouterr().err


@pytest.mark.processes
def test_an_interrupted_suite_ends_everything(tmp_path):
    work = tmp_path / "work"
    words = [sys.executable, "-X", "faulthandler", "-m", "tests.chaos", "--faults", "freezes", "--keep", str(work)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=os.environ) as suite:
        wait_until(lambda: len(list(work.glob("freezes/log/*.out"))) >= 3, 60.0, "processes of the suite")
        suite.send_signal(signal.SIGINT)
        try:
            said, _ = suite.communicate(timeout=30)
        except subprocess.TimeoutExpired:
            suite.send_signal(signal.SIGABRT)  # it says where it hangs
            raise
        assert said.splitlines()[-1] == "interrupted; everything is ended"
        assert suite.returncode == 130
    assert not _commands_with(str(work))


def _commands_with(text: str) -> list[str]:
    lines = (path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline") if path.exists())
    return [line.decode() for line in lines if text.encode() in line]
