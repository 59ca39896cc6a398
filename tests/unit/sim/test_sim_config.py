import dataclasses
from pathlib import Path

import pytest

from protocol.config import load_toml
from protocol.errors import ConfigError
from sim.config import SimConfig, load_sim

EXAMPLE = Path(__file__).parents[3] / "config" / "sim.toml"


def test_example_lists_every_option_with_its_default() -> None:
    assert load_sim(EXAMPLE) == SimConfig()
    assert set(load_toml(EXAMPLE)) == {f.name for f in dataclasses.fields(SimConfig)}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("site", "Paper/*"),
        ("machines", 0),
        ("names", ("a", "b")),
        ("names", ("a", "a", "b")),
        ("names", ("a", "*", "b")),
        ("seed", -1),
        ("seconds", -1.0),
        ("seconds", float("nan")),
        ("speed", -0.5),
        ("drive_mps", 0.1),
        ("gps", 4),
        ("imus", 0),
        ("outage_s", -1.0),
        ("outage_s", 11.0),
        ("outage_period_s", 0.0),
        ("gps_drift_std_m", -1.0),
        ("gps_drift_time_s", 0.0),
        ("gps_white_std_m", float("inf")),
        ("roughness_m", 1.0),
        ("bundle_ms", 0),
        ("bundle_ms", 55),
        ("start_ns", 0),
        ("wait_s", -1.0),
    ],
)
def test_bad_option_is_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ValueError, match=name):
        SimConfig(**{name: value})  # type: ignore[arg-type]


def test_unknown_key_is_refused_with_its_file(tmp_path: Path) -> None:
    path = tmp_path / "sim.toml"
    path.write_text("sped = 4\n")
    with pytest.raises(ConfigError, match=r"sim\.toml.*sped"):
        load_sim(path)


def test_machines_are_named_by_number_or_by_config() -> None:
    assert SimConfig(machines=2).machine_names == ("loader-1", "loader-2")
    assert SimConfig(machines=2, names=("a", "b")).machine_names == ("a", "b")


def test_bundles_cover_the_seconds() -> None:
    assert SimConfig(seconds=120.0).bundles == 2400
    assert SimConfig(seconds=0.12).bundles == 3
    assert SimConfig(seconds=0.0).bundles is None
