"""Arms: links, and spoiled machines."""

from pathlib import Path

import numpy as np
import pytest

from lab.campaign.recordings import make
from lab.cooperation.drives import LOST, STANDALONE, TWO, Arm, logs_of
from protocol.machine.log_folder import open_log
from protocol.machine.readings import Gps
from protocol.site.site_config import Projection
from sim.sensors.presets import load_preset

SECONDS = 30.0


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


def arm(spoiled: str = "") -> Arm:
    return Arm("two", TWO, 2, SECONDS, 8.0, spoiled=spoiled, world="fast")


def readings(cache: Path, scratch: Path, spoiled: str) -> tuple:
    drive = arm(spoiled).drive(1)
    make(drive, cache)
    logs = dict(logs_of(arm(spoiled), drive, cache, scratch))
    assert list(logs) == ["loader-1", "loader-2"]
    assert logs["loader-1"].is_relative_to(cache)
    log = open_log(logs["loader-2"])
    return log.machine, tuple(log.readings()), log.site


def test_a_link_is_lost_a_fifth_of_the_time_by_turns():
    cut = np.array([[LOST.weather(turn, second, 8.0).cut for second in range(3000)] for turn in range(4)])
    assert cut.mean(axis=1).tolist() == [0.2] * 4
    assert cut.sum(axis=0).max() == 1  # at most one machine at a time
    assert np.diff(np.flatnonzero(np.diff(cut[0].astype(int)) == 1)).tolist() == [300] * 9


@pytest.mark.slow
def test_standalone_receivers_are_further_off_and_say_so(cache: Path, tmp_path: Path):
    _, right, site = readings(cache, tmp_path, "")
    machine, wrong, _ = readings(cache, tmp_path, STANDALONE)
    noise = load_preset("standalone").gps
    fixes = [[r for r in each if isinstance(r, Gps)] for each in (right, wrong)]
    assert [r.stamp_ns for r in fixes[0]] == [r.stamp_ns for r in fixes[1]]
    places = [np.array([Projection(site).to_map(r.lat_deg, r.lon_deg, r.height_m)[:2] for r in each]) for each in fixes]
    assert np.hypot(*(places[1] - places[0]).T).mean() > 3.0
    assert fixes[1][0].var_e_m2 == pytest.approx(noise.drift_std_m**2 + noise.white_std_m**2)
    assert machine.sensor("gps-1").drift_time_s == noise.drift_time_s
    others = [[r for r in each if not isinstance(r, Gps)] for each in (right, wrong)]
    assert others[0] == others[1]
