import re
import tomllib
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest

from agents.config import MOST_LAG_S, AgentConfig, load_agent
from agents.drivers.tables import DriverConfig
from agents.estimation.ground import NOTHING_KNOWN
from agents.estimation.plausibility import FAULTS
from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig
from mapserver.trust.judgement import CLOCK_LIMIT_S
from protocol.errors import ConfigError
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.powertrain_config import PowertrainConfig
from protocol.site.site_config import SiteConfig
from protocol.site.site_file import load_site
from sim.scenario.file import load_scenario
from tests.paths import CONFIG


def table(name: str) -> dict[str, Any]:
    return tomllib.loads((CONFIG / name).read_text(encoding="utf-8"))


def unnamed(config: Any, named: dict[str, Any], place: str = "") -> list[str]:
    """Options of a nested dataclass absent from a TOML table."""
    missing = []
    for f in fields(config):
        value = getattr(config, f.name)
        if f.name not in named:
            missing.append(place + f.name)
        elif hasattr(value, "__dataclass_fields__"):
            missing += unnamed(value, named[f.name], f"{place}{f.name}.")
    return missing


def test_files_hold_the_defaults_and_what_the_scenario_has() -> None:
    paper = load_scenario("paper_site")
    assert load_agent(CONFIG / "agent.toml") == (paper.rigs()[0].machine, AgentConfig())
    assert load_site(CONFIG / "site.toml") == paper.site


def test_files_name_every_option() -> None:
    named = table("agent.toml")
    assert unnamed(AgentConfig(), named) == ["driver"]
    text = (CONFIG / "agent.toml").read_text()
    assert "\n# [[driver]]\n" in text, "in a comment: the simulator needs none"
    assert all(f"\n# {f.name} = " in text for f in fields(DriverConfig))
    assert {f.name for f in fields(SiteConfig)} == set(table("site.toml"))
    estimated = "machine_share", "skid_steers"  # estimated if absent, hence in a comment
    assert {f.name for f in fields(MachineConfig)} - {"sensors", "powertrain", *estimated} == set(named["machine"])
    for name in (*estimated, *(f.name for f in fields(PowertrainConfig))):
        assert f"\n# {name} = " in text
    assert "\n# [machine.powertrain]" in text
    assert {f.name for f in fields(SensorConfig)} == {key for sensor in named["sensor"] for key in sensor}
    assert {f.name for f in fields(Mount)} == set(named["sensor"][0]["mount"])


def written(folder: Path, text: str) -> Path:
    path = folder / "agent.toml"
    path.write_text(text)
    return path


def test_file_without_machine_leaves_it_to_the_log(tmp_path: Path) -> None:
    machine, config = load_agent(written(tmp_path, "linger_s = 1\n[pipeline.localisation]\nslip = 0.2\n"))
    assert machine is None
    assert (config.linger_s, config.pipeline.localisation.slip) == (1.0, 0.2)


def test_samples_that_are_late_by_the_lag_are_no_wrong_clock_to_the_server() -> None:
    """Also beside machines that send at once, with batches of a minute."""
    assert MOST_LAG_S + 60 < CLOCK_LIMIT_S
    longest = LocalisationConfig(lag_s=MOST_LAG_S)
    assert AgentConfig(PipelineConfig(longest)).pipeline.localisation.lag_s == MOST_LAG_S


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("lingers = 1", "unknown key `lingers`"),
        ("[pipeline]\nsampling = 2", "unknown key `sampling`"),
        ("[pipeline.localisation]\nslip = nan", "slip"),
        ("[pipeline.localisation]\nslip = 1", "slip"),
        ("[pipeline.localisation]\nfilter = 'kf'", "filter"),
        ("[pipeline.localisation]\nstep_s = 0.1", "unknown key `step_s`"),
        ("[uplink]\ntimeout_s = 0", "timeout_s"),
        ("[pipeline.estimation]\nmass = 'guessed'", "mass"),
        ("[pipeline.estimation]\nestimator = 'ukf'", "estimator"),
        ("[spool]\nmax_samples = 0", "max_samples"),
        ("[holdout]\noff_s = 11", "off_s"),
        ("linger_s = -1", "linger_s"),
        ("[pipeline.localisation]\nlag_s = 181", "lag_s: at most 180 s: the map server would take the clock for wrong"),
        ("[machine]\nname = 'No'", "name"),
        ("[machine]\nname = 'a'\nmass_kg = 0", "mass_kg"),
        (
            "[machine]\nname = 'a'\nwheelbase_m = 3\nmass_kg = 17.5",
            "17.5 kg is too little for .* of 3 m; if .* write 17500",
        ),
        ("[machine]\nname = 'a'\nmass_kg = 5e6", "mass_kg: 5000000.0 is not between 1 and 500000"),
        ("[machine]\nname = 'a'\n[[sensor]]\nname = 'g'\nkind = 'gps'\ndrift_share = 2", "drift_share"),
        (
            "[machine]\nname = 'a'\n[[sensor]]\nname = 'g'\nkind = 'gps'\n[[sensor]]\nname = 'g'\nkind = 'imu'",
            "sensors",
        ),
        ("[[sensor]]\nname = 'g'\nkind = 'gps'", "without a"),
        ("sensor = 3", "sensor"),
        ("[machine]\nname = 'a'\n[[sensor]]\nname = 'g'\nkind = 'gps'\nmount = { xyz_m = [0, 0, 3350] }", "write 3.35"),
        ("[corrections]\nbase = 'b'\nports = ['tcp://10.0.0.7:2947']", "2947 is gpsd, which takes none"),
        (
            "[corrections]\nbase = 'b'\nports = ['tcp://a:1']\n[[driver]]\nkind = 'gpsd'\naddress = 'tcp://a:1'",
            "tcp://a:1 is gpsd, which takes none",
        ),
    ],
)
def test_bad_option_is_refused_by_name_and_file(tmp_path: Path, text: str, problem: str) -> None:
    with pytest.raises(ConfigError, match=problem) as refused:
        load_agent(written(tmp_path, text))
    assert "agent.toml" in str(refused.value)


def test_page_of_ground_estimation_names_every_reason_and_none_else() -> None:
    page = (CONFIG.parent / "docs" / "how-the-map-comes-about.md").read_text(encoding="utf-8")
    modules = [*(CONFIG.parent / "agents" / "estimation").glob("*.py")]
    rows = set(
        re.findall(r"^\| ((?:`\w+`[ *,]*)+)\|", page[page.index("### Reasons") :].partition("\n## ")[0], re.MULTILINE)
    )
    reasons = {name for names in rows for name in re.findall(r"`(\w+)`", names)} - {"reason"}
    source = "".join(path.read_text(encoding="utf-8") for path in modules)
    assert not {reason for reason in reasons if f'"{reason}"' not in source}
    judged = (CONFIG.parent / "agents" / "estimation" / "plausibility.py").read_text(encoding="utf-8")
    given = set(re.findall(r'return "(\w+)"', judged)) | set(re.findall(r'_hold = "(\w+)"', judged))
    powertrain = (CONFIG.parent / "agents" / "estimation" / "powertrain.py").read_text(encoding="utf-8")
    given |= set(re.findall(r'(?:unknown=|return |else )"(\w+)"', powertrain))
    assert given | FAULTS | {NOTHING_KNOWN.reason, "settling"} == reasons
