"""The commands as a person or a script uses them."""

from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import cv2
import numpy as np
import pytest

from sitegrid.process.children import wait_until
from tests.integration.site_run import SiteRun  # beside this file

pytestmark = pytest.mark.processes


def sitegrid(*words: object, timeout_s: float = 120.0) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "sitegrid.cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)


def last_json(text: str) -> dict:
    return json.loads(text.strip().splitlines()[-1])


@pytest.fixture
def mapped(site_run: SiteRun) -> SiteRun:
    """A site with a map, its server still running."""
    site_run.start()
    site_run.end_of_agents()
    return site_run


def test_query_and_plot_answer_people_and_machines(mapped: SiteRun, tmp_path: Path):
    where = ("--endpoint", mapped.endpoint, "--site", "paper")
    info = last_json(sitegrid("query", *where, "--json", "info").stdout)
    assert info["machines"].keys() == {"loader-1", "loader-2", "loader-3"}
    with mapped.connect() as client:
        region = client.region((0, 0, 200, 150), ["resistance"])
    row, column = np.argwhere(np.isfinite(region["resistance"]))[0]
    x, y = region.x_m[column], region.y_m[row]
    point = last_json(sitegrid("query", *where, "--json", "point", x, y).stdout)
    assert point["resistance"] == pytest.approx(float(region["resistance"][row, column]))
    only = last_json(sitegrid("query", *where, "--json", "--layers", "visits", "point", x, y).stdout)
    assert "visits" in only
    assert "resistance" not in only
    people = sitegrid("query", *where, "point", x, y)
    assert "resistance " in people.stdout
    nowhere = sitegrid("query", *where, "point", -500, -500)
    assert "unknown" in nowhere.stdout
    saved = tmp_path / "region.npz"
    cells = last_json(sitegrid("query", *where, "--json", "region", 0, 0, 200, 150, "--out", saved).stdout)
    assert cells["columns"] == 200
    assert np.load(saved)["resistance"].shape == (150, 200)
    assert cells["layers"]["resistance"]["known"] == int(np.isfinite(region["resistance"]).sum())
    picture, truth = tmp_path / "map.png", mapped.folder / "truth" / "truth_map.npz"
    drawn = sitegrid("plot", *where, "--out", picture, "--truth", truth, "--bounds", 0, 0, 200, 150, "--json")
    difference = str(tmp_path / "map-difference.png")
    assert last_json(drawn.stdout) == {"picture": str(picture), "difference": difference}
    assert cv2.imread(str(picture)) is not None
    assert cv2.imread(difference) is not None
    late = sitegrid("query", *where, "--after", 10**6, "info", timeout_s=60)
    assert (late.returncode, late.stdout) == (1, "")
    assert "is not merged after" in late.stderr


def test_demo_prints_one_object_with_its_proof(tmp_path: Path, husky_data: Path):
    words = ("--seconds", 40, "--speed", 8, "--machines", 3, "--seed", 7, "--out", tmp_path, "--data", husky_data)
    manifest = Path("lab/logs/rl_test1_husky/log.toml").absolute()
    demo = sitegrid("demo", "--headless", "--json", *words, "--log", manifest, timeout_s=170)
    assert demo.returncode == 0, demo.stderr
    result = last_json(demo.stdout)
    assert (result["machines"], result["lost"], result["double"], result["seed"]) == (3, 0, 0, 7)
    assert result["samples_recorded"] == result["samples_merged"] > 300
    assert result["cells"] > 500
    assert 0 <= result["wrong_resistance_pct"] < 25
    assert 0 <= result["wrong_grade_pct"] < 10
    assert len(result["pictures"]) == 3
    assert all(cv2.imread(picture) is not None for picture in result["pictures"])
    log = result["log"]
    assert (log["name"], log["lost"], log["double"]) == ("husky", 0, 0)
    assert log["recorded"] > 500
    assert log["withheld_fixes"] > 80
    assert log["withheld_rms_m"] < 2.0


def test_ctrl_c_ends_everything_that_the_demo_started(tmp_path: Path):
    words = ["demo", "--headless", "--machines", "1", "--json", "--out", str(tmp_path)]
    command = [sys.executable, "-m", "sitegrid.cli", *words]
    demo = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        picture = tmp_path / "map.png"
        wait_until(picture.exists, 60.0, "machines drive")
        started = children_of(demo.pid)
        assert len(started) == 4, "router, server, simulator, agent"
        demo.send_signal(signal.SIGINT)
        _, errors = demo.communicate(timeout=30)
    finally:
        demo.kill()
        demo.wait()
    assert demo.returncode == 130
    assert "everything is ended" in errors
    assert not [pid for pid in started if is_alive(pid)]


def test_on_a_terminal_the_page_of_the_demo_stays_until_ctrl_c(tmp_path: Path):
    terminal, its_end = pty.openpty()
    words = ["demo", "--web", "--machines", "1", "--world", "fast", "--seconds", "20", "--out", str(tmp_path)]
    command = [sys.executable, "-m", "sitegrid", *words]
    with subprocess.Popen(command, stdin=its_end, stdout=its_end, stderr=its_end) as demo:
        try:
            shown = b""
            while not (stays := re.search(rb"stays at (http://\S+)/ until Ctrl-C", shown)):
                shown += os.read(terminal, 4096)
            started = children_of(demo.pid)
            with urllib.request.urlopen(f"{stays[1].decode()}/api/v1/sites/paper/info", timeout=20) as answer:
                assert json.load(answer)["samples_merged"] > 0
            assert b"A site on this host: router, map server" in shown
            demo.send_signal(signal.SIGINT)
            assert demo.wait(30) == 0
        finally:
            demo.kill()
            os.close(terminal)
            os.close(its_end)
    assert len(started) == 3, "router, map server, page"
    assert not [pid for pid in started if is_alive(pid)]


def children_of(pid: int) -> list[int]:
    return [int(p) for p in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("query", "--endpoint", "tcp/127.0.0.1:9", "info"), "start one with `sitegrid router`"),
        (("server", "--site-file", "none.toml", "--store", "x"), "none.toml: no such file"),
        (("agent", "--spool", "x.db"), "see config/agent.toml"),
        (("agent", "--spool", "x.db", "--driver", "replay"), "--driver replay needs --log"),
        (("sim", "--machines", "0"), "machines: 0 is not between"),
        (("demo", "--machines", "0"), "machines: 0 is not between"),
    ],
)
def test_errors_are_one_line_that_says_what_to_do(words: tuple[str, ...], problem: str, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    process = sitegrid(*words)
    assert process.returncode == 1
    assert problem in process.stderr
    assert len(process.stderr.strip().splitlines()) == 1


def test_wrong_usage_exits_with_2():
    assert sitegrid("query", "point", "north", "1").returncode == 2
    assert sitegrid("plot", "--every", "0").returncode == 2
    assert sitegrid("fly").returncode == 2
