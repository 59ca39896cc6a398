"""Replaced fixes from the truth with given errors."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.campaign.recordings import PAPER, PlannedDrive, RecordedDrive, load, make
from lab.positions.substitution import TrueMotion, gps_errors, true_motion, with_gps_errors
from protocol.machine.readings import Gps
from sim.sensors.presets import load_preset
from sim.simulator import START_NS

DRIVE = PlannedDrive(3, 15.0, setup=replace(PAPER, world="fast"))
NOISE = load_preset("paper").gps
QUICK = replace(NOISE, drift_time_s=0.2)  # readings 0.2 s apart correlate by 1/e: half of them count
LONG_NS = START_NS + 500_000_000_000
FIXES = 5 * 500


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[RecordedDrive, TrueMotion]:
    folder: Path = make(DRIVE, tmp_path_factory.mktemp("cache"))
    return load(folder), true_motion(folder)


def fixes(recording: RecordedDrive) -> list[Gps]:
    return [r for r in recording.readings if isinstance(r, Gps)]


@pytest.mark.slow
def test_the_seed_of_a_recording_gives_its_own_fixes_again(recorded: tuple[RecordedDrive, TrueMotion]):
    recording, motion = recorded
    again = with_gps_errors(recording, motion, gps_errors(recording.machine, NOISE, DRIVE.seed, motion.stamp_ns[-1]))
    assert len(fixes(recording)) > 150
    assert again == recording


@pytest.mark.slow
def test_another_seed_changes_fixes_alone_and_none_where_receivers_were_silent(
    recorded: tuple[RecordedDrive, TrueMotion],
):
    recording, motion = recorded
    perfect = replace(NOISE, drift_std_m=0.0, white_std_m=0.0)
    only = ("gps-1",)
    errors = gps_errors(recording.machine, NOISE, 99, motion.stamp_ns[-1])
    other = with_gps_errors(recording, motion, {name: errors[name] for name in only})
    assert [(r.sensor, r.stamp_ns) for r in other.readings] == [(r.sensor, r.stamp_ns) for r in recording.readings]
    pairs = list(zip(recording.readings, other.readings, strict=True))
    assert {before.sensor for before, after in pairs if before != after} == set(only)
    true = with_gps_errors(recording, motion, gps_errors(recording.machine, perfect, 99, motion.stamp_ns[-1]))
    assert all(
        before.var_e_m2 > after.var_e_m2 == 1e-4 for before, after in zip(*map(fixes, (other, true)), strict=True)
    )


def test_an_antenna_sits_on_its_lever_arm_and_turns_with_the_machine():
    sensor = next(s for s in DRIVE.machine.sensors if s.name == "gps-2")
    stamps = np.array([0, 1_000_000_000])
    motion = TrueMotion(stamps, np.array([[10.0, 0.0, 2.0], [12.0, 0.0, 2.0]]), np.array([[0.0, 0, 0], [0, 0, np.pi]]))
    antenna = motion.antenna_m(sensor, np.array([0, 500_000_000, 1_000_000_000, 2_000_000_000]))
    ahead, left, up = sensor.mount.xyz_m
    expected = [[10 + ahead, left, 2 + up], [11 - left, ahead, 2 + up], [12 - ahead, -left, 2 + up]]
    np.testing.assert_allclose(antenna[:3], expected, atol=1e-9)
    assert np.isnan(antenna[3]).all()


@pytest.mark.parametrize(("machine_share", "site_share"), [(0.0, 0.0), (0.95, 0.0), (0.95, 0.8), (0.5, 0.5)])
def test_slow_errors_correlate_by_the_shares_and_white_ones_never(machine_share: float, site_share: float):
    noise = replace(QUICK, machine_share=machine_share, site_share=site_share)
    one, other = (gps_errors(DRIVE.machine, noise, 5, LONG_NS, number) for number in (0, 7))
    tolerance = 5 / np.sqrt(FIXES / 2)
    for a, b, expected in (
        (one["gps-1"], one["gps-2"], machine_share),
        (one["gps-2"], one["gps-3"], machine_share),
        (one["gps-1"], other["gps-1"], site_share),
    ):
        for axis in range(3):
            assert np.corrcoef(a.slow_m[:, axis], b.slow_m[:, axis])[0, 1] == pytest.approx(expected, abs=tolerance)
            assert np.corrcoef(a.white_m[:, axis], b.white_m[:, axis])[0, 1] == pytest.approx(0, abs=tolerance)
