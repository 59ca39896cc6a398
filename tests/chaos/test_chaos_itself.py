"""The fault suite detects losses: models, verdicts, command."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys

import pytest

from agents.delivery.spool import Spool, SpoolConfig
from protocol.machine.samples import empty
from tests.chaos import __main__ as command
from tests.chaos import bit_flips, site_faults, stepped_clock
from tests.chaos.__main__ import ChaosFault, run_suite
from tests.chaos.disk_model import Disk, Kind, Operation
from tests.chaos.outcome import Console, FaultOutcome, longest_pause, table
from tests.chaos.scenario import FaultRun


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


def test_the_wall_clock_of_a_child_is_stepped_and_its_waits_are_not(tmp_path):
    stepped_clock.write(tmp_path / "clock", -3600 * 10**9)
    code = (
        "import sys, time; from pathlib import Path; from tests.chaos import stepped_clock as s;"
        "true, start = time.time(), time.monotonic(); s._step_clocks(Path(sys.argv[1])); time.sleep(0.01);"
        "print(round((time.time() - true) / 60), round((time.monotonic() - start) / 60), time.time_ns() < true * 1e9)"
    )
    words = [sys.executable, "-c", code, str(tmp_path / "clock")]
    assert subprocess.run(words, capture_output=True, text=True, check=True).stdout.split() == ["-60", "0", "True"]


def test_a_pause_leaves_out_what_the_fault_lasted():
    commits = [0.0, 1.0, 9.0, 10.0]
    assert longest_pause(commits, [], 11.0) == 8.0
    assert longest_pause(commits, [(2.0, 7.0)], 11.0) == 3.0
    assert longest_pause(commits, [(2.0, 5.0), (4.0, 7.0)], 11.0) == 3.0
    assert longest_pause(commits, [(0.0, 9.0)], 15.0) == 5.0


def test_the_order_of_kills_comes_from_the_seed(tmp_path):
    runs = [FaultRun("kills", tmp_path, None, Console(line=lambda *_, **__: None), 3, 4.0, 0.02) for _ in range(2)]
    drawn = [site_faults.draw_kills(run.rng, ("a", "b"), 200, 60.0) for run in runs]
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


def test_a_loss_that_was_named_fails_the_suite_and_is_not_silent():
    outcome = FaultOutcome("restored_store", recorded=9, merged=8, lost=1, named=1)
    assert not outcome.is_good
    header, row = (line.split()[:9] for line in table([outcome]).splitlines())
    shown = dict(zip(header, row, strict=True))
    assert [shown[name] for name in ("declared", "lost", "named", "silent")] == ["0", "1", "1", "0"]
