"""The end of a process: asked for by a signal, and in time whatever it is doing; and addresses of metrics."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sitegrid.command_line import build_parser
from sitegrid.process import progress
from sitegrid.process.children import Children, ProcessError
from sitegrid.process.progress import COMPILING, Display

STUBBORN = """
import sys, time
from sitegrid.process.logs import start_logging
from sitegrid.process.lifetime import stop_flag
start_logging(verbose=False)
stop = stop_flag({end_s})
print("ready", flush=True)
stop.wait(20)
time.sleep({late_s})
print("done", flush=True)
sys.exit(3)
"""
# A lock that is never released, waited for in C: handlers of Python do not run, as inside of Zenoh.
STUCK = """
import ctypes, os
from sitegrid.process.lifetime import stop_flag
stop_flag(0.3)
print("ready", flush=True)
mutex = ctypes.create_string_buffer(256)
pthread = ctypes.CDLL(None)
pthread.pthread_mutex_lock(mutex)
pthread.pthread_mutex_lock(mutex)
"""
TIDY = """
import sys, time
from sitegrid.process.lifetime import raise_interrupts
raise_interrupts()
try:
    print("ready", flush=True)
    time.sleep(20)
except KeyboardInterrupt:
    print("tidied", flush=True)
sys.exit(3)
"""
# Blocks that are freed between others that stay: the second of each size used to lie in the heap.


def ended(code: str, number: signal.Signals = signal.SIGTERM) -> tuple[int, str, str, float]:
    """Exit code, output, errors, and how long the end took."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code], **pipes) as process:
        try:
            assert process.stdout.readline() == "ready\n"
            begin_s = time.monotonic()
            process.send_signal(number)
            output, errors = process.communicate(timeout=20)
        finally:
            process.kill()
    return process.returncode, output, errors, time.monotonic() - begin_s


def test_who_ends_in_time_ends_as_it_likes():
    code, output, errors, _ = ended(STUBBORN.format(end_s=15, late_s=0))
    assert (code, output, errors) == (3, "done\n", "")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_who_has_to_tidy_up_may(number: signal.Signals):
    assert ended(TIDY, number)[:3] == (3, "tidied\n", "")


def test_who_does_not_end_is_ended_and_that_is_logged():
    code, output, errors, took_s = ended(STUBBORN.format(end_s=0.3, late_s=60))
    assert (code, output) == (0, "")
    assert json.loads(errors)["event"] == "ended in mid-work"
    assert took_s >= 0.3


def test_a_process_that_is_stuck_outside_of_python_is_ended_too():
    assert ended(STUCK)[0] == 0


@pytest.mark.parametrize(
    ("words", "address"),
    [
        ([], None),
        (["--metrics"], ("127.0.0.1", 9464)),
        (["--metrics", "9000"], ("127.0.0.1", 9000)),
        (["--metrics", ":9000"], ("127.0.0.1", 9000)),
        (["--metrics", "0.0.0.0:9000"], ("0.0.0.0", 9000)),
    ],
)
def test_metrics_are_for_this_host_unless_told(words: list[str], address: tuple[str, int] | None):
    arguments = build_parser().parse_args(["server", "--site-file", "s", "--store", "x", *words])
    assert arguments.metrics == address


def test_a_child_is_waited_for_as_long_as_it_says_that_it_goes_on(tmp_path, monkeypatch):
    """Kernels take longer than a child may be silent; whoever waits hears of them, and may end it in between."""
    program = tmp_path / "program"
    lines = "\n".join(["echo '{\"compiling\": 1}'"] * 4 + ["echo '{\"ready\": 1}'", "exec sleep 60"])
    program.write_text(f"#!/bin/sh\n{lines}\n")
    program.chmod(0o755)
    monkeypatch.setattr("sitegrid.process.children.sys.executable", str(program))
    now_s = 0.0
    monkeypatch.setattr("sitegrid.process.children.time.monotonic", lambda: now_s)

    def meanwhile(line: dict) -> None:
        nonlocal now_s
        now_s += 10 if line else 0.01

    with Children(tmp_path, meanwhile) as children:
        child = children.start("server")
        assert child.expect("ready", 15) == {"ready": 1}
        assert now_s >= 40
        with pytest.raises(ProcessError, match=r"server: did not print `ended` within 0\.05 s"):
            child.expect("ended", 0.05)


def test_compiled_kernels_are_named_and_those_of_the_cache_are_not(tmp_path, monkeypatch):
    code = """
import numba
from sitegrid.process.progress import compilation_reported
@numba.njit(cache=True)
def twice(x):
    return 2 * x
with compilation_reported():
    twice(1)
"""
    (tmp_path / "kernel.py").write_text(code)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    command = [sys.executable, str(tmp_path / "kernel.py")]
    first, second = (subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2))
    assert json.loads(first) == {"compiling": 1, "kernel": "twice", "note": COMPILING}
    assert second == ""


def test_a_kernel_that_compiles_for_long_is_reported_again(tmp_path):
    code = """
import numba
from sitegrid.process import progress
progress.EVERY_S = 0.001
with progress.compilation_reported():
    numba.njit(lambda x: 2 * x)(1)
"""
    (tmp_path / "kernel.py").write_text(code)
    command = [sys.executable, str(tmp_path / "kernel.py")]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    assert len(said) > 1
    assert {json.loads(line)["compiling"] for line in said} == {1}


def test_plain_lines_come_now_and_then_only(monkeypatch, capsys):
    now = iter([100.0, 100.0, 101.0, 106.0, 106.0])
    monkeypatch.setattr(progress.time, "monotonic", lambda: next(now))
    display = Display("machines drive", headless=True)
    for second in (1, 2, 3):
        display.show(second, 10, "recording")
    assert capsys.readouterr().err.count("recording") == 2


@pytest.mark.parametrize("kept", [None, Path("out")])
def test_who_interrupts_is_told_whether_the_command_goes_on(kept: Path | None, capsys):
    with pytest.raises(KeyboardInterrupt), Display("machines drive", headless=True, kept=kept):
        raise KeyboardInterrupt
    said = capsys.readouterr().err
    assert ("interrupted; what is done is kept in out, and the same command goes on with it" in said) == bool(kept)
