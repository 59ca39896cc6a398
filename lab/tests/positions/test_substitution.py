"""Readings made anew from the truth: fixes with the errors that are asked for, wheels and gyros without errors."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.campaign.recordings import PAPER, PlannedDrive, RecordedDrive, load, make
from lab.positions.substitution import (
    GpsErrors,
    TrueMotion,
    gps_errors,
    true_motion,
    with_gps_errors,
    with_true_turn,
    with_true_wheels,
    without_side_slip,
    without_slow_errors,
)
from protocol.machine.readings import Encoder, Gps, Imu
from protocol.rotations import matrix_from_rpy
from protocol.site.site_config import Projection
from sim.sensors.presets import load_preset
from sim.simulator import START_NS

DRIVE = PlannedDrive(3, 15.0, setup=replace(PAPER, world="fast"))
NOISE = load_preset("paper").gps
QUICK = replace(NOISE, drift_time_s=0.2)  # of which readings 0.2 s apart correlate by 1/e: half of them count
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


def test_errors_have_the_variances_of_the_preset_at_every_share():
    for machine_share, site_share in ((0.0, 0.0), (0.5, 0.2), (1.0, 1.0)):
        noise = replace(QUICK, machine_share=machine_share, site_share=site_share)
        for errors in gps_errors(DRIVE.machine, noise, 5, LONG_NS).values():
            assert errors.slow_m[:, :2].std() == pytest.approx(1.23 * 1.342, rel=5 / np.sqrt(FIXES))
            assert errors.white_m[:, :2].std() == pytest.approx(1.23 * 0.447, rel=5 / np.sqrt(4 * FIXES))
            assert errors.stated_m2[0] == pytest.approx(1.23**2 * (1.342**2 + 0.447**2))


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


def test_errors_repeat_with_their_seed_and_last_as_long_as_the_preset_says():
    errors = [gps_errors(DRIVE.machine, NOISE, seed, LONG_NS)["gps-1"] for seed in (5, 5, 6)]
    np.testing.assert_array_equal(errors[0].total_m, errors[1].total_m)
    assert abs(errors[0].total_m - errors[2].total_m).max() > 1
    many = [gps_errors(DRIVE.machine, NOISE, seed, START_NS + 60_000_000_000) for seed in range(60)]
    slow = np.array([e.slow_m[:, :2] for run in many for e in run.values()])  # 180 receivers, independent
    later = (slow[:, 225] * slow[:, 0]).mean() / (slow[:, 0] ** 2).mean()
    assert later == pytest.approx(np.exp(-1), abs=5 / np.sqrt(360))


def test_a_stamp_at_which_no_receiver_reads_is_an_error():
    errors = gps_errors(DRIVE.machine, NOISE, 5, START_NS + 2_000_000_000)["gps-1"]
    assert errors.rows(errors.stamp_ns[[3, 1]]).tolist() == [3, 1]
    for off in (1, -200_000_000, 10**12):
        with pytest.raises(ValueError, match="between its instants"):
            errors.rows(errors.stamp_ns[:1] + off)
    assert isinstance(errors, GpsErrors)


# --- the truth in place of wheels, turn rate, side slip and slow errors ----------------------------------------------


def circling(speed_mps: float, turn_radps: float, crab_rad: float) -> TrueMotion:
    """A machine on a circle at 10 Hz for a minute, which moves off its heading to the left."""
    stamps = np.arange(601) * 100_000_000
    course = turn_radps * stamps * 1e-9
    yaw = course - crab_rad
    radius_m = speed_mps / turn_radps
    places = np.stack([radius_m * np.sin(course), -radius_m * np.cos(course), np.zeros_like(course)], axis=1)
    return TrueMotion(stamps, places, np.stack([np.zeros_like(yaw), np.zeros_like(yaw), yaw], axis=1))


def test_a_machine_that_crabs_has_a_velocity_to_its_side():
    motion, at = circling(3.0, 0.2, 0.05), np.array([0, 1_234_000_000, 20_000_000_000])
    np.testing.assert_allclose(
        motion.velocity_mps()[5:-5], [[3 * math.cos(0.05), 3 * math.sin(0.05), 0]] * 591, atol=1e-6
    )
    driven = 3.0 * at * 1e-9
    np.testing.assert_allclose(motion.distance_m(at), np.outer(driven, [math.cos(0.05), math.sin(0.05)]), atol=1e-5)
    np.testing.assert_allclose(motion.turn_rate_radps(at), 0.2, atol=1e-9)
    # along the left of a heading of 0.2 t - 0.05: the integral of its sine and cosine
    end = 0.2 * at[2] * 1e-9 - 0.05
    gained = 3 * math.sin(0.05) / 0.2 * np.array([math.cos(end) - math.cos(-0.05), math.sin(end) - math.sin(-0.05)])
    np.testing.assert_allclose(motion.sideways_m(at)[2], gained, atol=1e-5)


def test_the_turn_rate_is_that_about_the_machines_own_upright_axis():
    stamps = np.arange(101) * 100_000_000
    t = stamps * 1e-9
    angles = np.stack([0.2 * np.sin(t), 0.15 * np.cos(1.3 * t), 0.4 * t], axis=1)
    motion = TrueMotion(stamps, np.zeros((101, 3)), angles)
    step = 1e-5
    for at in (2.03, 5.57):
        before, after = (
            matrix_from_rpy(0.2 * math.sin(s), 0.15 * math.cos(1.3 * s), 0.4 * s) for s in (at - step, at + step)
        )
        turn = (before.T @ after - np.eye(3)) / (2 * step)
        assert motion.turn_rate_radps(np.array([round(at * 1e9)]))[0] == pytest.approx(turn[1, 0], abs=1e-5)


def changed(before: RecordedDrive, after: RecordedDrive) -> set[str]:
    """Sensors whose readings differ; stamps and their order never do."""
    assert [(r.sensor, r.stamp_ns) for r in before.readings] == [(r.sensor, r.stamp_ns) for r in after.readings]
    return {a.sensor for a, b in zip(before.readings, after.readings, strict=True) if a != b}


@pytest.mark.slow
def test_true_wheels_turn_as_far_as_the_machine_moves(recorded: tuple[RecordedDrive, TrueMotion]):
    recording, motion = recorded
    true = with_true_wheels(recording, motion)
    assert changed(recording, true) == {"wheels"}
    ticks = [[r for r in one.readings if isinstance(r, Encoder)] for one in (recording, true)]
    per_m = 100 / (2 * math.pi * recording.machine.wheel_radius_m)
    metres = [np.array([(r.left_ticks + r.right_ticks) / 2 / per_m for r in own]) for own in ticks]
    moved = np.hypot(*np.diff(motion.position_m[:, :2], axis=0).T).sum()  # level there, and driven forwards
    assert np.ptp(metres[1]) == pytest.approx(moved, rel=1e-3)
    assert abs(np.ptp(metres[0]) - moved) > 0.005 * moved  # its wheels are not of the nominal radius
    for before, after in zip(*ticks, strict=True):
        assert after.left_ticks - after.right_ticks == pytest.approx(before.left_ticks - before.right_ticks, abs=1e-6)


@pytest.mark.slow
def test_true_gyros_turn_as_far_as_the_machine_does(recorded: tuple[RecordedDrive, TrueMotion]):
    recording, motion = recorded
    true = with_true_turn(recording, motion)
    assert changed(recording, true) == {"imu-3", "imu-4"}  # those on the rear frame, which is `base_link`
    sensor = recording.machine.sensor("imu-3")
    assert sensor
    rates = [
        np.array(
            [
                (r.gyro_x_radps, r.gyro_y_radps, r.gyro_z_radps)
                for r in one.readings
                if isinstance(r, Imu) and r.sensor == "imu-3"
            ]
        )
        @ sensor.mount.frame_from_sensor().T
        for one in (recording, true)
    ]
    np.testing.assert_allclose(rates[1][:, :2], rates[0][:, :2], atol=1e-12)
    turned = motion.attitude_rad[-1, 2] - motion.attitude_rad[0, 2]
    by_gyro, by_truth = (np.trapezoid(own[9:, 2], dx=0.01) for own in rates)  # the true track begins after 0.1 s
    assert by_truth == pytest.approx(turned, abs=2e-4)
    assert by_gyro != pytest.approx(turned, abs=2e-4)
    forces = [[r.force_x_mps2 for r in one.readings if isinstance(r, Imu)] for one in (recording, true)]
    assert forces[0] == forces[1]


@pytest.mark.slow
def test_without_side_slip_a_machine_goes_where_it_heads_and_its_fixes_err_as_before(
    recorded: tuple[RecordedDrive, TrueMotion],
):
    recording, motion = recorded
    straight = without_side_slip(recording, motion)
    assert changed(recording, straight) == {"gps-1", "gps-2", "gps-3"}
    moved = motion.position_m.copy()
    moved[:, :2] += straight.truth.position_m - recording.truth.position_m
    slid, left = motion.velocity_mps()[:, 1], replace(motion, position_m=moved).velocity_mps()[:, 1]
    assert abs(slid).max() > 0.01
    assert abs(left).max() < 0.02 * abs(slid).max()
    projection = Projection(recording.site)
    for old, new in list(zip(fixes(recording), fixes(straight), strict=True))[::20]:
        a, b = (np.array(projection.to_map(r.lat_deg, r.lon_deg, r.height_m)) for r in (old, new))
        stamp = np.array([old.stamp_ns])
        shift = straight.truth.at(stamp)[0] - recording.truth.at(stamp)[0]
        np.testing.assert_allclose(b - a, [*shift, 0.0], atol=1e-4)


def test_without_slow_errors_white_noise_is_left_and_stated():
    errors = gps_errors(DRIVE.machine, NOISE, 5, LONG_NS)
    white = without_slow_errors(errors)
    for name, own in white.items():
        assert (own.slow_m == 0).all()
        assert (own.total_m == errors[name].white_m).all()
        np.testing.assert_allclose(own.stated_m2[:2], (NOISE.scale * NOISE.white_std_m) ** 2, rtol=0.15)
