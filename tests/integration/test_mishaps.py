"""Mishaps of real processes: Ctrl-C while loading, closed terminals, vanished readers."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
import termios
from pathlib import Path

import pytest

from protocol.machine.log_folder import open_log
from protocol.wire.session import free_endpoint
from sitegrid.command_line import INTERRUPTED
from tests.command_lines import COMMANDS
from tests.integration.site_run import SiteRun  # beside this file
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.processes

# Ctrl-C before the n-th import; every command would end by itself soon.
IMPORTS = (1, 100, 350)
LINES = {command.words[0]: command.line({"endpoint": "none"}) for command in reversed(COMMANDS)} | {
    "agent": ["agent", "--spool", "x.db"],
    "demo": ["demo", "--machines", "0"],
    "log": ["log", "run", "missing"],
    "router": ["router", "--listen", "none"],
}
# A process without imports, whose forks start like the command.
FORKS = """
import os, signal, sys
import sitegrid.cli

class CtrlC:
    def __init__(self, left):
        self.left = left
    def find_spec(self, name, path=None, target=None):
        self.left -= 1
        if self.left == 0:
            os.kill(os.getpid(), signal.SIGINT)

cases, results = eval(sys.argv[1]), []
for i, (left, words) in enumerate(cases):
    if (pid := os.fork()) == 0:
        errors = os.open(f"{i}.err", os.O_WRONLY | os.O_CREAT)
        os.dup2(errors, 1), os.dup2(errors, 2)
        sys.meta_path.insert(0, CtrlC(left))
        sys.exit(sitegrid.cli.main(words))
    results.append(os.waitpid(pid, 0)[1])
print(results)
"""


def sitegrid(*words: object) -> list[str]:
    return [sys.executable, "-m", "sitegrid.cli", *map(str, words)]


@pytest.mark.nightly
def test_ctrl_c_while_a_command_loads_ends_it_without_a_word(tmp_path: Path):
    cases = [(left, line) for line in LINES.values() for left in IMPORTS]
    words = [sys.executable, "-c", FORKS, repr(cases)]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=PATIENCE_S, check=True)
    interrupted = dict.fromkeys(LINES, 0)
    for i, ((left, words), status) in enumerate(zip(cases, json.loads(done.stdout), strict=True)):
        said = (tmp_path / f"{i}.err").read_text()
        code = os.waitstatus_to_exitcode(status)
        if code in (-signal.SIGINT, INTERRUPTED):
            assert said == "", (left, words)
            interrupted[words[0]] += 1
        else:  # fewer imports: ended by itself
            assert code in (0, 1), (left, words, said)
            assert "Traceback" not in said
    assert min(interrupted.values()) >= 2, interrupted


def test_a_shell_sees_130(tmp_path: Path):
    code = "import os, signal, sys; from sitegrid.cli import main; import sitegrid.commands.router as r;"
    code += "r.run = lambda _: os.kill(os.getpid(), signal.SIGINT) or 0; sys.exit(main(['router']))"
    shell = subprocess.run(["sh", "-c", f'"{sys.executable}" -c "{code}"; echo $?'], capture_output=True, text=True)
    assert (shell.stdout, shell.stderr) == ("130\n", "")


def test_a_reader_that_leaves_a_pipe_is_no_error(site: SiteRun):
    site.start_router()
    site.start_server()
    where = ("--endpoint", site.endpoint, "--site", site.site)
    for words, taken in ((["info"], "head -1"), (["--json", "info"], "true")):
        line = " ".join(map(repr, sitegrid("query", *where, *words)))
        shell = subprocess.run(
            ["bash", "-c", f"{line} | {taken}; echo ${{PIPESTATUS[0]}}"], capture_output=True, text=True, check=True
        )
        assert shell.stdout.endswith("0\n"), shell.stdout
        assert shell.stderr == ""


def test_a_terminal_that_is_closed_ends_a_process_in_order(site: SiteRun, tmp_path: Path):
    router, server = site.start_router(), site.start_server()
    for child in (site.start_agent(site.configs[0]), server, router):
        child.send(signal.SIGHUP)
        assert child.wait(PATIENCE_S) == 0
        assert '"signal": "SIGHUP"' in (tmp_path / f"{child.name}.log").read_text()
    assert not (site.folder / "store" / "journal.db-wal").exists(), "closed, not cut off"


@pytest.mark.nightly
def test_nohup_keeps_a_process(tmp_path: Path):
    endpoint = free_endpoint()
    command = ["nohup", *sitegrid("router", "--listen", endpoint)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=tmp_path) as router:
        try:
            assert b"ready" in router.stdout.readline()  # type: ignore[union-attr]
            router.send_signal(signal.SIGHUP)
            again = subprocess.run(sitegrid("router", "--listen", endpoint), capture_output=True, check=False)
            assert b"already in use" in again.stderr, "the first one goes on"
            assert router.poll() is None
            router.send_signal(signal.SIGTERM)
            assert router.wait(PATIENCE_S) == 0
        finally:
            router.kill()


@pytest.mark.nightly
def test_a_demo_whose_terminal_is_closed_leaves_nothing(tmp_path: Path):
    words = ("demo", "--headless", "--machines", 1, "--world", "fast", "--out", tmp_path / "out")
    with subprocess.Popen(sitegrid(*words), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        try:
            until(lambda: len(children_of(demo.pid)) >= 2, "router and server")
            started = children_of(demo.pid)
            demo.send_signal(signal.SIGHUP)
            _, errors = demo.communicate(timeout=PATIENCE_S)
        finally:
            demo.kill()
    assert "SIGHUP" in errors
    assert "Traceback" not in errors
    assert not [pid for pid in started if Path(f"/proc/{pid}").exists()]


def children_of(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


@pytest.mark.nightly
def test_a_recording_outlives_its_terminal(tmp_path: Path):
    """SIGHUP, and a blocked terminal."""
    ours, theirs = os.openpty()
    words = sitegrid("sim", "--record", "logs", "--machines", 1, "--world", "fast", "--seconds", 3000)
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), theirs)
    terminal = {**pipes, "start_new_session": True, "preexec_fn": lambda: fcntl.ioctl(0, termios.TIOCSCTTY)}
    with subprocess.Popen(words, cwd=tmp_path, **terminal) as sim:
        try:
            os.close(theirs)
            said = b""
            while said.count(b"recording") < 3:  # redrawn while recording
                said += os.read(ours, 1000)
            os.close(ours)
            assert sim.wait(PATIENCE_S) == 0
        finally:
            sim.kill()
    assert len(list(open_log(tmp_path / "logs" / "loader-1").readings())) > 50
