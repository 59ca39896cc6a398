"""Options that only act inside a running command: each test fails when its option is ignored."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from mapserver.config import ServerConfig
from protocol.machine.log_folder import open_log
from protocol.site.geometry import Bounds
from sim.scenario.file import FOLDER, load_scenario
from sitegrid.cli import build_parser
from sitegrid.commands import agent, plot, server
from sitegrid.demo.plan import DEFAULT_MANIFEST
from sitegrid.pictures import draw
from tests.paths import ROOT


class Stop:
    """A stop flag that notes how long it was waited for, and is never set."""

    def __init__(self) -> None:
        self.waits: list[float] = []

    def is_set(self) -> bool:
        return False

    def wait(self, seconds: float) -> bool:
        self.waits.append(seconds)
        return False


class Nothing:
    """Stands for a client and for its tracks."""

    session = None

    def __enter__(self) -> Nothing:
        return self

    def __exit__(self, *_: object) -> None: ...

    def tracks(self) -> list[object]:
        return []

    def close(self) -> None: ...


@pytest.fixture
def drawn(monkeypatch) -> tuple[list[tuple[Any, ...]], Stop]:
    pictures: list[tuple[Any, ...]] = []
    stop = Stop()
    monkeypatch.setattr(draw, "stop_flag", lambda: stop)
    monkeypatch.setattr(draw, "connect", lambda *_, **__: Nothing())
    monkeypatch.setattr(draw, "TrackRecorder", lambda *_: Nothing())
    monkeypatch.setattr(draw, "draw", lambda _, *rest: pictures.append(rest))
    return pictures, stop


def test_plot_waits_between_pictures_and_ends_after_so_many(drawn):
    pictures, stop = drawn
    words = ["plot", "--follow", "--every", "2.5", "--pictures", "3"]
    assert plot.run(build_parser().parse_args(words)) == 0
    assert len(pictures) == 3
    assert stop.waits == [2.5, 2.5]


def test_plot_draws_once_what_it_is_told_to(drawn):
    pictures, stop = drawn
    words = ["plot", "--out", "a.png", "--bounds", "1", "2", "3", "4", "--truth", "t.npz"]
    plot.run(build_parser().parse_args(words))
    assert pictures == [(Path("a.png"), [1.0, 2.0, 3.0, 4.0], [], Path("t.npz"))]
    assert stop.waits == []
    assert draw._bounds(None, [1.0, 2.0, 3.0, 4.0]) == Bounds(1, 2, 3, 4)


def test_replay_takes_its_speed(husky_data: Path):
    manifest = ROOT / DEFAULT_MANIFEST
    words = ["agent", "--spool", "x", "--driver", "replay", "--log", str(manifest), "--speed", "7"]
    log = open_log(manifest, husky_data)
    driver = agent._driver(build_parser().parse_args(words), log, None, log.site.name, log.machine.name)
    assert driver._speed == 7


def test_server_takes_the_options_of_its_file(tmp_path: Path, monkeypatch):
    options, site = tmp_path / "server.toml", tmp_path / "site.toml"
    options.write_text("query_threads = 5\n[fold]\nstd_cap_m = 2.0\n")
    site.write_text('name = "pit"\norigin_lat_deg = 49.0\norigin_lon_deg = 8.0\n')
    configs: list[ServerConfig] = []

    class Failed(Nothing):
        failed = True  # so that the command ends at once

        def __init__(self, *given: Any) -> None:
            configs.append(given[3])

    monkeypatch.setattr(server, "stop_flag", Stop)
    monkeypatch.setattr("sitegrid.commands.server.open_session", lambda _: Nothing())
    monkeypatch.setattr("mapserver.server.Server", Failed)
    words = ["server", "--site-file", str(site), "--store", str(tmp_path / "store"), "--config", str(options)]
    assert server.run(build_parser().parse_args(words)) == 1
    assert (configs[0].query_threads, configs[0].fold.std_cap_m) == (5, 2.0)


def test_the_demo_keeps_off_the_seeds_that_reports_are_made_on():
    assert build_parser().parse_args(["demo"]).seed is None
    assert all(load_scenario(path.stem).seed < 1000 for path in FOLDER.glob("*.toml"))


@pytest.mark.parametrize(("words", "expected"), [([], "a.calibration.json"), (["--calibration", "b.json"], "b.json")])
def test_agent_keeps_its_calibration_beside_the_spool_or_where_it_is_told(words: list[str], expected: str) -> None:
    arguments = build_parser().parse_args(["agent", "--spool", "a.db", *words])
    assert agent._calibration(arguments) == Path(expected)
