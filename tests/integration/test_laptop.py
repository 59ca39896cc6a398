"""A new user's laptop: receiver on a port, `init`, `doctor`, `up`, Ctrl-C; real processes."""

from __future__ import annotations

import os
import signal
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from protocol.wire import keys
from protocol.wire.codec import decode_health
from sitegrid import connect
from sitegrid.process.children import Child, Children
from tests.patience import PATIENCE_S, until
from tests.unit.agents.drivers.frames import PVT, pvt
from tests.unit.sitegrid.setup.test_listening import IMU, on_a_port

pytestmark = pytest.mark.processes
SPEED_MPS = 8.0
BEGIN = datetime(2026, 11, 26, 10, tzinfo=UTC)
EAST_PER_M = 1 / 73_000  # degrees of longitude at 49 degrees north


def driving(begun_s: float) -> bytes:
    """Current bytes of a receiver moving east."""
    passed_s = round(time.monotonic() - begun_s, 3)
    at = BEGIN + timedelta(seconds=passed_s)
    date = {
        "year": at.year,
        "month": at.month,
        "day": at.day,
        "hour": at.hour,
        "minute": at.minute,
        "second": at.second,
    }
    lon_1e7 = PVT.lon_1e7 + round(SPEED_MPS * passed_s * EAST_PER_M * 1e7)
    moves = {"east_mmps": round(SPEED_MPS * 1e3), "north_mmps": 0, "lon_1e7": lon_1e7, "nano": at.microsecond * 1000}
    return pvt(**date, **moves, itow_ms=round(passed_s * 1e3)) + IMU


def children_of(parent: Child) -> dict[str, int]:
    """Processes of `up`, by command."""
    listed = Path(f"/proc/{parent.pid}/task/{parent.pid}/children").read_text("ascii").split()
    commands = {pid: Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0") for pid in map(int, listed)}
    return {words[3].decode(): pid for pid, words in commands.items() if b"sitegrid.cli" in words}


def up(children: Children, name: str, folder: Path) -> tuple[Child, dict[str, Any]]:
    child = children.start(name, "up", folder, "--json")
    return child, child.expect("ready", PATIENCE_S)


def test_a_receiver_comes_from_its_port_to_the_map_and_ctrl_c_ends_all(tmp_path: Path) -> None:
    folder, begun_s = tmp_path / "quarry", time.monotonic()
    made = ("init", folder, "--model", "loader", "--json")
    with on_a_port(tmp_path, lambda: driving(begun_s)) as port, Children(tmp_path) as children:
        written = children.start("init", *made, "--port", port).expect("written", PATIENCE_S)
        assert written["missing"].keys() == {"resistance"}
        checked = children.start("doctor", "doctor", folder, "--json").expect("ok", PATIENCE_S)
        assert {f["level"] for f in checked["findings"] if f["check"] != "ports"} <= {"PASS", "-"}
        running, ready = up(children, "first", folder)
        health = dict[str, Any]()
        with connect(ready["endpoint"], "quarry", timeout_s=PATIENCE_S) as client:
            key = keys.health("quarry", "loader-1")
            client.session.declare_subscriber(key, lambda s: health.update(decode_health(s.payload.to_bytes()).values))
            until(lambda: health.get("pipeline", {}).get("aligned"), "a heading, by fixes")
            assert health["driver"][f"{port} frames_ubx"] > 10
            assert not health["driver_problems"]
        started = children_of(running)
        assert started.keys() == {"router", "server", "web", "agent"}
        running.send(signal.SIGINT)
        assert running.wait(PATIENCE_S) == 0
        again, _ = up(children, "again", folder)
        started_again = children_of(again)
        os.kill(started_again["web"], signal.SIGKILL)
        assert again.wait(PATIENCE_S) == 1
        left = [pid for pid in (*started.values(), *started_again.values()) if Path(f"/proc/{pid}").exists()]
        assert not left
    assert "web: ended with -9, so all is ended" in (tmp_path / "again.log").read_text("utf-8")
    assert "`sitegrid up " in (tmp_path / "first.log").read_text("utf-8")
