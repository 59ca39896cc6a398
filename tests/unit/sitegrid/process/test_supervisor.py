"""systemd is told that a process is ready and that it lives; the units are as systemd wants them, and confined."""

from __future__ import annotations

import os
import re
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import pytest

from protocol.wire.session import free_endpoint
from sitegrid.command_line import build_parser
from sitegrid.process.supervisor import ALIVE, READY, turns
from tests.paths import ROOT

UNITS = sorted((ROOT / "config/systemd").glob("*.service"))
EXPOSURE = 2.5  # of 10, at most
HEARD_S = 120.0


@pytest.fixture
def supervisor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """The socket that a supervisor listens at."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.settimeout(HEARD_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        yield listening


@pytest.mark.processes
def test_a_process_says_that_it_is_ready_and_goes_on_saying_that_it_lives(supervisor):
    words = [sys.executable, "-m", "sitegrid", "router", "--listen", free_endpoint()]
    with subprocess.Popen(words, env=dict(os.environ), stdout=subprocess.DEVNULL) as router:
        try:
            assert [supervisor.recv(64).decode() for _ in range(3)] == [READY, ALIVE, ALIVE]
        finally:
            router.terminate()


def test_work_that_hangs_is_not_said_to_live(supervisor):
    supervisor.setblocking(False)
    for _ in islice(turns(threading.Event(), 0.0, lives=lambda: False), 3):
        with pytest.raises(BlockingIOError):
            supervisor.recv(64)
    next(turns(threading.Event(), 0.0))
    assert supervisor.recv(64).decode() == ALIVE


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="no systemd")
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_unit_is_one_and_is_confined(unit, tmp_path):
    here = tmp_path / unit.name
    here.write_text(unit.read_text().replace("/opt/sitegrid/bin/sitegrid", sys.executable))
    verified = subprocess.run(["systemd-analyze", "verify", here], capture_output=True, text=True, check=False)
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", here], capture_output=True, text=True, check=False
    )
    assert float(re.findall(r"exposure level for \S+: ([\d.]+)", judged.stdout)[0]) <= EXPOSURE


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_the_command_of_a_unit_is_one_of_this_program(unit):
    line = re.findall(r"^ExecStart=/opt/sitegrid/bin/sitegrid (.*)$", unit.read_text(), re.MULTILINE)[0]
    line = line.replace("${ENDPOINT}", "tls/10.0.0.5:7447").replace("%i", "loader-1")
    assert build_parser().parse_args(line.split()).keys
