"""Clock offsets in a recording: measured by motion and named with a correcting `delay_s`, or unknown."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from agents.localisation.localiser import LocalisationConfig
from protocol.machine.log_folder import write_log
from protocol.machine.readings import Gps, Reading
from sitegrid.logs.check import examine
from sitegrid.logs.run import read_recording, run
from sitegrid.proof.figures import Row
from tests.tiers import by_night
from tests.unit.agents.drives import SITE, Leg, drive, machine, noisy, thinned

VEHICLE = machine(receivers=2)
DAY = 86_400.0
STEADY = (Leg(4, 0.5), Leg(116))


def work(seed: int, seconds: float = 150.0) -> tuple[Leg, ...]:
    """Irregular starts, stops and bends."""
    rng, legs, speed_mps, left_s = np.random.default_rng(seed), [], 0.0, seconds
    while left_s > 0:
        length_s, wanted_mps = float(rng.integers(4, 11)), float(rng.choice([0.0, 1.5, 3.0, 4.5]))
        turn_radps = float(rng.uniform(-0.25, 0.25)) if wanted_mps and speed_mps else 0.0
        legs.append(Leg(length_s, (wanted_mps - speed_mps) / length_s, turn_radps))
        speed_mps, left_s = wanted_mps, left_s - length_s
    return tuple(legs)


@cache
def recorded(legs: tuple[Leg, ...], seed: int = 0) -> list[Reading]:
    """A drive with 0.7 m fix errors and gyro noise."""
    rng = np.random.default_rng(seed)
    readings = noisy(thinned(drive(legs, VEHICLE).readings), seed)
    off_deg = rng.normal(0, 0.7 / 111_200, (len(readings), 2))
    return [
        replace(r, lat_deg=r.lat_deg + a, lon_deg=r.lon_deg + b) if isinstance(r, Gps) else r
        for r, (a, b) in zip(readings, off_deg.tolist(), strict=True)
    ]


def log_of(folder: Path, readings: list[Reading], **ahead_s: float) -> Path:
    """A log with some sensors' clocks ahead."""
    made = [replace(r, stamp_ns=r.stamp_ns + round(ahead_s.get(key(r.sensor), 0.0) * 1e9)) for r in readings]
    names = {reading.sensor for reading in made}
    vehicle = replace(VEHICLE, sensors=tuple(s for s in VEHICLE.sensors if s.name in names))
    write_log(folder, "lot", SITE, vehicle, made)
    return folder


def key(sensor: str) -> str:
    return sensor.replace("-", "_")


def without(*sensors: str, legs: tuple[Leg, ...]) -> list[Reading]:
    return [reading for reading in recorded(legs) if reading.sensor not in sensors]


def proposed(folder: Path) -> dict[str, float]:
    """Proposals by sensor, each in one line with the manifest entry."""
    delays_s: dict[str, float] = {}
    for finding in examine(folder).findings:
        if match := re.search(r"; write `delay_s = (-?[\d.]+)` under its name \(\+- [\d.]+ s\)$", str(finding)):
            delays_s[finding.check] = float(match[1])
    return delays_s


def mend(folder: Path, delays_s: dict[str, float]) -> None:
    """Write the proposals into the manifest."""
    head, *tables = (folder / "log.toml").read_text().split("[[sensor]]\n")
    for i, table in enumerate(tables):
        name = table.partition('name = "')[2].partition('"')[0]
        if name in delays_s:
            tables[i] = re.sub(r"delay_s = .*", f"delay_s = {delays_s[name]}", table)
    (folder / "log.toml").write_text("[[sensor]]\n".join([head, *tables]))


def replayed(folder: Path) -> tuple[Row, list[str]]:
    """A replay's row, and messages."""
    said: list[str] = []
    report = run(read_recording(folder, None), LocalisationConfig("ekf"), [None], on_progress=said.append)
    assert all(any(clock in line for line in said) for clock in report["clocks"])
    return report["rows"][0], said


APART = {
    "leap seconds": {"gps_1": 18.0},
    "a boot clock": {"gps_1": 1.7e9},
    "wheels and gyro since boot": {"imu": -1.7e9, "wheels": -1.7e9, "torque": -1.7e9},
    "a time zone": {"gps_1": -7200.0},
    "a day": {"gps_1": DAY},
    "a slow receiver": {"gps_1": 1.5},
    "an early receiver": {"gps_1": -2.0},
    "a slow gyro": {"imu": 2.0},
    "early wheels": {"wheels": -3.0},
    "torque as well": {"gps_1": -5 * DAY, "torque": -5 * DAY},
}


@pytest.mark.slow
@pytest.mark.parametrize("case", by_night(APART, day=("leap seconds", "a slow gyro", "early wheels")))
def test_an_offset_is_proposed_and_mends_the_log(tmp_path: Path, case: str) -> None:
    """The minority is set to the majority; on a tie of wheels and gyro, the receiver is set."""
    ahead_s = APART[case]
    log_of(tmp_path, without("gps-2", legs=work(1)), **ahead_s)
    expected = ahead_s if len(ahead_s) < 3 else {"gps_1": 1.7e9}
    delays_s = proposed(tmp_path)
    assert {key(name): delay_s for name, delay_s in delays_s.items()} == pytest.approx(expected, abs=0.4)
    mend(tmp_path, delays_s)
    examined = examine(tmp_path)
    assert examined.ok
    assert proposed(tmp_path) == {}


@pytest.mark.slow
def test_one_of_two_receivers_is_named(tmp_path: Path) -> None:
    log_of(tmp_path, recorded(work(2)), gps_2=-18.0)
    assert proposed(tmp_path) == pytest.approx({"gps-2": -18.0}, abs=0.4)


@pytest.mark.slow
@pytest.mark.parametrize("seed", by_night(range(3), day=[0]))
def test_a_sound_log_has_no_proposal(tmp_path: Path, seed: int) -> None:
    log_of(tmp_path, recorded(work(seed), seed), gps_1=0.1, wheels=-0.1)
    assert proposed(tmp_path) == {}


@pytest.mark.slow
@pytest.mark.parametrize("ahead_s", [5.0, 4 * DAY])
def test_a_steady_drive_tells_no_offset(tmp_path: Path, ahead_s: float) -> None:
    """Stamps without overlap are named anyway."""
    log_of(tmp_path, without("gps-2", legs=STEADY), gps_1=ahead_s)
    lines = [str(finding) for finding in examine(tmp_path).findings if finding.check == "gps-1"]
    assert proposed(tmp_path) == {}
    assert any("when no other sensor has any; look at the unit" in line for line in lines) == (ahead_s > DAY)


@pytest.mark.slow
@pytest.mark.parametrize(("ahead_s", "is_located"), by_night([(18.0, True), (1.7e9, False)], day=[(1.7e9, False)]))
def test_with_what_is_proposed_positions_are_as_good_as_ever(tmp_path: Path, ahead_s: float, is_located: bool) -> None:
    """Before, positions are far off or missing; the replay says why."""

    legs = work(1, 80.0)
    made = drive(legs, VEHICLE)
    (tmp_path / "evaluation.toml").write_text('truth = { file = "true.csv", stamp = "t", x_m = "x", y_m = "y" }')
    rows = zip(made.stamps_ns[::20], made.x_m[::20].tolist(), made.y_m[::20].tolist(), strict=True)
    (tmp_path / "true.csv").write_text("t,x,y\n" + "".join(f"{t * 1e-9:.3f},{x},{y}\n" for t, x, y in rows))
    readings = without("gps-2", "torque", legs=legs)
    apart, said = replayed(log_of(tmp_path, readings, gps_1=ahead_s))
    assert any("gps-1: its stamps are" in line for line in said)
    assert (apart["covered"] > 0) == is_located
    assert is_located == ("lot: no pose, as clocks are apart" not in said)
    assert not apart["truth_net_m"] < 4.0
    mend(tmp_path, proposed(tmp_path))
    mended, _ = replayed(tmp_path)
    assert mended["truth_net_m"] < 2.0
