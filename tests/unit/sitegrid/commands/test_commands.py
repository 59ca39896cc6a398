"""Options of commands reach their targets."""

from __future__ import annotations

import json
from argparse import Namespace
from dataclasses import replace
from pathlib import Path

import pytest

from agents.config import AgentConfig
from protocol.errors import ConfigError
from protocol.machine.log_folder import open_log
from protocol.machine.machine_config import machine_toml
from protocol.site.site_file import load_site
from protocol.wire.session import free_endpoint
from sim.config import resolve
from sim.scenario.file import load_scenario
from sim.truth import TruthMap
from sitegrid.cli import main
from sitegrid.command_line import build_parser
from sitegrid.commands import agent, sim
from tests.paths import ROOT

MACHINE = load_scenario("paper_site").rigs()[0].machine
MANIFEST = ROOT / "lab/logs/rl_test1_husky/log.toml"


def parse(*words: object) -> Namespace:
    return build_parser().parse_args([str(word) for word in words])


def test_sim_options_go_over_the_config(tmp_path: Path):
    file = tmp_path / "sim.toml"
    file.write_text('seconds = 5.0\nseed = 3\nmachines = 2\nnames = ["a", "b"]\n')
    plain = sim._config(parse("sim", "--config", file))
    assert (plain.seconds, plain.seed, resolve(plain).machine_names) == (5, 3, ("a", "b"))
    words = ("--seconds", 7, "--speed", 2, "--machines", 1, "--seed", 4, "--site", "pit")
    words = (*words, "--scenario", "repaved", "--world", "fast", "--preset", "rtk", "--all-sensors")
    over = sim._config(parse("sim", "--config", file, *words))
    assert (over.seconds, over.speed, over.seed, over.site) == (7, 2, 4, "pit")
    assert (over.scenario, over.world, over.preset) == ("repaved", "fast", "rtk")
    assert (over.gps, over.imu, over.attitude) == ((1, 2, 3), (1, 2, 3, 4), (1, 2, 3, 4))
    assert resolve(over).machine_names == ("loader-1",)


@pytest.mark.slow
def test_sim_records_log_folders_and_truth(tmp_path: Path, capsys):
    logs, truth = tmp_path / "logs", tmp_path / "truth"
    words = ["--record", str(logs), "--truth", str(truth), "--seconds", "2", "--machines", "2"]
    assert main(["sim", "--json", *words]) == 0
    assert json.loads(capsys.readouterr().out)["machines"] == 2
    assert len(list(open_log(logs / "loader-2").readings())) > 300
    assert TruthMap.load(truth / "truth_map.npz").c_rr.shape == (150, 200)
    assert not list(logs.rglob("*truth*"))


@pytest.mark.slow
def test_sim_says_once_that_machines_drive_and_where_receivers_speak(tmp_path: Path, capsys):
    ports = tmp_path / "ports"
    words = ["--ports", str(ports), "--world", "fast", "--machines", "1", "--seconds", "1.5"]
    assert main(["sim", "--endpoint", free_endpoint(), *words]) == 0
    begun, ended = capsys.readouterr().err.splitlines()
    assert begun == f"machines drive; receivers speak on {ports}/*"
    assert ended.startswith("simulated 1.5 s of 1 machines: ")


def test_sim_writes_what_agents_need(tmp_path: Path):
    assert main(["sim", "--write-configs", str(tmp_path), "--machines", "2", "--site", "pit"]) == 0
    assert load_site(tmp_path / "site.toml").name == "pit"
    _, machine, _ = agent._configure(
        parse("agent", "--spool", "x", "--config", tmp_path / "loader-2.toml", "--site-file", tmp_path / "site.toml"),
        None,
    )
    assert machine == load_scenario("paper_site").rigs()[1].machine


@pytest.fixture
def files(tmp_path: Path) -> Path:
    (tmp_path / "agent.toml").write_text("linger_s = 3.5\n" + machine_toml(replace(MACHINE, name="digger")))
    (tmp_path / "site.toml").write_text('name = "pit"\norigin_lat_deg = 49.0\norigin_lon_deg = 8.0\n')
    return tmp_path


def test_agent_takes_machine_site_and_options_from_its_files(files: Path):
    words = ("agent", "--spool", "x", "--config", files / "agent.toml", "--site-file", files / "site.toml")
    site, machine, config = agent._configure(parse(*words), None)
    assert (site.name, machine.name, config.linger_s) == ("pit", "digger", 3.5)
    _, renamed, _ = agent._configure(parse(*words, "--name", "loader-7"), None)
    assert renamed.name == "loader-7"


def test_a_log_brings_machine_and_site(tmp_path: Path):
    log = open_log(MANIFEST, tmp_path)
    words = ("agent", "--spool", "x", "--driver", "replay", "--log", MANIFEST)
    site, machine, config = agent._configure(parse(*words), log)
    assert (site.name, machine.name, config) == ("husky-lot", "husky", AgentConfig())


def test_what_an_agent_lacks_is_named(files: Path):
    with pytest.raises(ConfigError, match="--site-file is missing"):
        agent._configure(parse("agent", "--spool", "x", "--config", files / "agent.toml"), None)
    with pytest.raises(ConfigError, match=r"no \[machine\] is described"):
        agent._configure(parse("agent", "--spool", "x", "--site-file", files / "site.toml"), None)


# --- options that only act inside a running command -------------------------------------------------------------------


@pytest.mark.parametrize(("words", "expected"), [([], "a.calibration.json"), (["--calibration", "b.json"], "b.json")])
def test_agent_keeps_its_calibration_beside_the_spool_or_where_it_is_told(words: list[str], expected: str) -> None:
    arguments = build_parser().parse_args(["agent", "--spool", "a.db", *words])
    assert agent._calibration(arguments) == Path(expected)


def test_a_page_shows_sites_by_name_and_endpoint(capsys):
    words = ["web", "--site", "pit=tcp/127.0.0.1:7448", "--site", "north"]
    assert build_parser().parse_args(words).sites == [("pit", "tcp/127.0.0.1:7448"), ("north", None)]
    with pytest.raises(SystemExit):
        build_parser().parse_args(["web", "--site", "a/b"])
    assert "a/b" in capsys.readouterr().err
