from __future__ import annotations

import json
import os
import pty
import re
import signal
import subprocess
import sys
import urllib.request
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pytest

from sim.config import SimConfig
from sim.recorder import write_truth
from sim.simulator import Simulator
from tests.command_lines import said
from tests.integration.web_site import NAME, WebSite
from tests.patience import PATIENCE_S, until

pytestmark = pytest.mark.processes


def test_query_and_plot_answer_people_and_machines(web: WebSite, tmp_path: Path):
    where = ("--endpoint", web.endpoint, "--site", NAME)
    assert said("query", *where, "--json", "info").json["machines"].keys() == {"machine-0", "machine-1", "machine-2"}
    region = web.client.region((0, 0, 200, 150), ["resistance"])
    row, column = np.argwhere(np.isfinite(region["resistance"]))[0]
    x, y = region.x_m[column], region.y_m[row]
    point = said("query", *where, "--json", "point", x, y).json
    assert point["resistance"] == pytest.approx(float(region["resistance"][row, column]))
    only = said("query", *where, "--json", "--layers", "visits", "point", x, y).json
    assert "visits" in only
    assert "resistance" not in only
    assert "resistance " in said("query", *where, "point", x, y).out
    assert "nobody was there" in said("query", *where, "point", -500, -500).out
    saved = tmp_path / "region.npz"
    cells = said("query", *where, "--json", "region", 0, 0, 200, 150, "--out", saved).json
    assert cells["columns"] == 200
    assert np.load(saved)["resistance"].shape == (150, 200)
    assert cells["layers"]["resistance"]["known"] == int(np.isfinite(region["resistance"]).sum())


def test_plot_draws_the_map_and_how_it_differs_from_the_truth(web: WebSite, tmp_path: Path):
    with closing(Simulator(SimConfig(machines=1, seconds=1, world="fast"))) as simulator:
        write_truth(tmp_path, simulator)
    words = ("--truth", tmp_path / "truth_map.npz", "--bounds", 0, 0, 200, 150, "--json")
    where = ("--endpoint", web.endpoint, "--site", NAME)
    drawn = said("plot", *where, "--out", tmp_path / "map.png", *words).json
    assert drawn["picture"] == str(tmp_path / "map.png")
    assert drawn["difference"] == str(tmp_path / "map-difference.png")
    assert all(cv2.imread(drawn[name]) is not None for name in ("picture", "difference"))


@pytest.mark.nightly
def test_demo_prints_one_object_with_its_proof(tmp_path: Path, husky_data: Path):
    words = ("--seconds", 40, "--speed", 8, "--machines", 3, "--seed", 7, "--out", tmp_path, "--data", husky_data)
    manifest = Path("lab/logs/rl_test1_husky/log.toml").absolute()
    result = said("demo", "--headless", "--json", *words, "--log", manifest).json
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


@pytest.mark.nightly
def test_ctrl_c_ends_everything_that_the_demo_started(tmp_path: Path):
    words = ["demo", "--headless", "--machines", "1", "--json", "--out", str(tmp_path)]
    command = [sys.executable, "-m", "sitegrid.cli", *words]
    demo = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        picture = tmp_path / "map.png"
        until(picture.exists, "machines drive")
        started = children_of(demo.pid)
        assert len(started) == 4, "router, server, simulator, agent"
        demo.send_signal(signal.SIGINT)
        _, errors = demo.communicate(timeout=PATIENCE_S)
    finally:
        demo.kill()
        demo.wait()
    assert demo.returncode == 130
    assert "everything is ended" in errors
    assert not [pid for pid in started if is_alive(pid)]


@pytest.mark.nightly
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
            with urllib.request.urlopen(f"{stays[1].decode()}/api/v1/sites/paper/info", timeout=PATIENCE_S) as answer:
                assert json.load(answer)["samples_merged"] > 0
            assert b"A site on this host: router, map server" in shown
            demo.send_signal(signal.SIGINT)
            assert demo.wait(PATIENCE_S) == 0
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
