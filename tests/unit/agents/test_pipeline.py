import csv
import math
from dataclasses import replace
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.estimation.calibration import Calibration
from agents.localisation.filters.belief import PoseBelief
from agents.localisation.filters.smoother import SmoothedPose
from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import KEPT_NS, Pipeline, SmoothedTrack
from agents.positioning import PipelineConfig, Positioning
from agents.sampling import joined
from protocol.machine.log_folder import open_log
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import KINDS, Encoder, Gps, Imu, Reading, Torque, columns
from protocol.machine.samples import check_samples
from protocol.site.site_config import KnownGround
from sim.config import SimConfig
from sim.recorder import record
from tests.tiers import by_night
from tests.unit.agents.drives import (
    PROJECTION,
    S_BEND,
    SITE,
    START,
    START_NS,
    VEHICLE,
    Drive,
    Ground,
    Leg,
    changed_sensor,
    drive,
    seconds,
    simulated,
    thinned,
)

SECOND = 10**9


@pytest.fixture(scope="module")
def recorded() -> list[Reading]:
    """A simulated drive of 26 s with site events.

    A 2 s stop at 12 s; fixes 60 m off from 15 to 18 s; silence of 3 s at 20 s.
    """
    stop_ns, stand_ns = START_NS + 12 * SECOND, 2 * SECOND
    readings = thinned(simulated(3, 26.0)[2], 20)
    troubled = [r for r in readings if r.stamp_ns <= stop_ns]
    still = next(r for r in reversed(troubled) if isinstance(r, Encoder))
    for stamp in range(stop_ns + 10_000_000, stop_ns + stand_ns, 10_000_000):
        troubled.append(Imu("imu-3", stamp, 0.001, 0.001, 0.003, 0.0, 0.0, 9.81))
        troubled += [replace(still, stamp_ns=stamp)] if stamp % 50_000_000 == 0 else []
    for r in readings:
        if stop_ns < r.stamp_ns <= START_NS + 18 * SECOND or r.stamp_ns > START_NS + 21 * SECOND:
            off_deg = 6e-4 if 13 < seconds(r) < 16 else 0.0
            later = replace(r, stamp_ns=r.stamp_ns + stand_ns)
            troubled.append(replace(later, lat_deg=r.lat_deg + off_deg) if isinstance(r, Gps) else later)
    late_fix = next(r for r in troubled if isinstance(r, Gps) and seconds(r) > 10)
    behind = next(i for i, r in enumerate(troubled) if r.stamp_ns > late_fix.stamp_ns + 150_000_000)
    troubled.remove(late_fix)
    troubled.insert(behind, late_fix)
    return troubled


def lagging(lag_s: float, **options: Any) -> PipelineConfig:
    """From the simulated drive's start: a given start needs no proof."""
    return PipelineConfig(LocalisationConfig("ekf", lag_s=lag_s, start=(29.143, 18.503, -0.339), **options))


LAG = 5.0  # samples become final within these drives
STARTED = PipelineConfig(LocalisationConfig("ekf", start=START))  # of synthetic drives
Base = tuple[bytes, bytes, Any]


def simulated_pipeline(vehicle: MachineConfig, config: PipelineConfig | None = None) -> Pipeline:
    return Pipeline(simulated(3, 26.0)[0], vehicle, config or lagging(LAG))


def run(vehicle: MachineConfig, readings: list[Reading]) -> Base:
    """Pending and final samples as bytes, and health."""
    pipeline = simulated_pipeline(vehicle)
    samples = pipeline.step(readings)
    return samples.pending.tobytes(), samples.final.tobytes(), pipeline.health()


@pytest.fixture(scope="module")
def vehicle() -> MachineConfig:
    return simulated(3, 26.0)[1]


@pytest.fixture(scope="module")
def base(vehicle: MachineConfig, recorded: list[Reading]) -> Base:
    return run(vehicle, recorded)


def test_the_aid_by_lanes_feels_the_slopes_of_all_samples(vehicle: MachineConfig, recorded: list[Reading]) -> None:
    pipeline, felt = simulated_pipeline(vehicle), []
    assert pipeline.lanes
    pipeline.lanes.feel = felt.append  # type: ignore[method-assign]
    samples = pipeline.step(recorded)
    assert np.concatenate(felt).tobytes() == samples.pending.tobytes()
    assert len(samples.pending) > 20


# --- what goes in and comes out --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_made_up_drive_gives_right_samples() -> None:
    made = drive([*S_BEND, *S_BEND], VEHICLE)
    rows = Pipeline(SITE, VEHICLE, PipelineConfig()).step(thinned(made.readings, 20)).pending
    check_samples(rows, SITE.extent_m)
    settled = rows[40:]
    assert np.median(settled["c_rr"]) == pytest.approx(0.04, abs=0.004)
    assert np.abs(settled["grade_e"]).max() < 0.05
    assert max(off_m(made, row) for row in settled) < 0.6


@pytest.mark.slow
def test_any_cutting_of_the_stream_gives_the_same_samples(
    vehicle: MachineConfig, recorded: list[Reading], base: Base
) -> None:
    pipeline = simulated_pipeline(vehicle)
    cuts = sorted(np.random.default_rng(1).choice(len(recorded), size=500).tolist())
    made = [pipeline.step(recorded[a:b]) for a, b in zip([0, *cuts], [*cuts, len(recorded)], strict=True)]
    pending, final = (np.concatenate(rows).tobytes() for rows in zip(*made, strict=True))
    assert (pending, final, pipeline.health()) == base


@pytest.mark.slow
def test_no_order_of_sensor_tables_and_of_readings_of_a_stamp_changes_a_bit(
    vehicle: MachineConfig, recorded: list[Reading], base: Base
) -> None:
    groups = [[*group] for _, group in groupby(recorded, key=attrgetter("stamp_ns"))]
    readings = [reading for group in groups for reading in reversed(group)]
    assert readings != recorded
    assert run(replace(vehicle, sensors=vehicle.sensors[::-1]), readings) == base


@pytest.mark.slow
def test_strange_and_doubled_readings_are_counted_and_change_nothing(
    vehicle: MachineConfig, recorded: list[Reading], base: Base
) -> None:
    strangers = [replace(recorded[100], sensor="stranger"), Encoder("imu-3", recorded[100].stamp_ns, 0.0, 0.0)]
    *samples, health = run(vehicle, [*recorded[:101], *strangers, *recorded[101:900], *recorded[850:]])
    assert samples == [*base[:2]]
    assert health["counters"]["reading_unknown_sensor"] == 2
    assert health["counters"]["reading_duplicate"] + health["counters"]["reading_late"] >= 50


@pytest.mark.slow
@pytest.mark.parametrize(("jump_s", "reason"), [(3600, "gap_restarts"), (-3600, "clock_back_restarts")])
def test_a_start_that_is_told_counts_once(jump_s: int, reason: str) -> None:
    """After a pause or clock jump the machine is elsewhere and waits for fixes."""
    made, jump_ns = drive([Leg(4, 1.0), Leg(26)], VEHICLE), START_NS + 20 * SECOND
    readings = thinned(made.readings)
    located = Positioning(SITE, VEHICLE, STARTED)
    located.step([r for r in readings if r.stamp_ns <= jump_ns])
    assert located.pose
    later = [replace(r, stamp_ns=r.stamp_ns + jump_s * SECOND) for r in readings if r.stamp_ns > jump_ns]
    located.step([r for r in later if not isinstance(r, Gps)])
    assert located.counters[reason] == 1
    assert located.pose is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("without", "measures", "has_slope"),
    [(("imu", "torque"), (), False), (("torque",), (), True), ((), ("rate",), False)],
)
def test_a_machine_that_lacks_sensors_gives_samples_without_resistance_or_slope(
    without: tuple[str, ...], measures: tuple[str, ...], has_slope: bool
) -> None:
    """Also an IMU without accelerometer, whose force columns hold arbitrary values."""
    made = drive([Leg(4, 0.5), Leg(16)], VEHICLE, without=without)
    vehicle = changed_sensor(VEHICLE, "imu", measures=measures) if measures else VEHICLE
    rows = Pipeline(SITE, vehicle, STARTED).step(thinned(made.readings, 20)).pending
    check_samples(rows, SITE.extent_m)
    assert len(rows) > 40
    assert np.isnan(rows["c_rr"]).all()
    assert np.isfinite(rows["grade_e"]).all() if has_slope else np.isnan(rows["grade_e"]).all()


@pytest.mark.nightly
@pytest.mark.slow
def test_machine_that_aligns_late_loses_nothing_of_its_drive() -> None:
    """GPS comes two minutes into the drive, beyond the memory of poses."""
    made = drive([Leg(4, 0.5), *[Leg(10), Leg(5, 0, 0.3)] * 8, *S_BEND[1:]], VEHICLE)
    readings = [r for r in thinned(made.readings) if not isinstance(r, Gps) or seconds(r) > 120]
    pipeline = Pipeline(SITE, VEHICLE, PipelineConfig(LocalisationConfig("ekf")))
    rows = joined([pipeline.step(readings), pipeline.finish()]).pending
    assert int(rows["stamp_ns"][0]) < START_NS + 5 * SECOND
    assert pipeline.health()["withheld"].get("no_pose", 0) <= 2


# --- pending and final -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("config", [lagging(0.0), lagging(90.0, profile="paper")], ids=["lag 0", "paper"])
def test_without_a_lag_samples_are_final_at_once(
    config: PipelineConfig, vehicle: MachineConfig, recorded: list[Reading]
) -> None:
    pipeline = simulated_pipeline(vehicle, config)
    samples = pipeline.step(recorded[: len(recorded) // 2])
    assert len(samples.final) > 20
    assert samples.final.tobytes() == samples.pending.tobytes()
    assert pipeline.pending == 0


@pytest.mark.slow
def test_samples_are_final_once_the_lag_is_over_at_the_smoothed_place(
    vehicle: MachineConfig, recorded: list[Reading]
) -> None:
    """Final samples equal the separate smoother's; the last come at the stream's end."""
    site, config = simulated(3, 26.0)[0], lagging(LAG)
    pipeline, apart = Pipeline(site, vehicle, config), Positioning(site, vehicle, config)
    pending, final, nodes = [], [], []
    for i in range(0, len(recorded), 10):
        now_ns = max(r.stamp_ns for r in recorded[: i + 10])
        samples = pipeline.step(recorded[i : i + 10])
        nodes += apart.step(recorded[i : i + 10])
        pending.append(samples.pending)
        final.append(samples.final)
        assert pipeline.pending == sum(map(len, pending)) - sum(map(len, final))
        if len(samples.final):
            assert LAG <= (now_ns - samples.final["stamp_ns"][-1]) * 1e-9 <= LAG + 5.0  # silence of 3 s
    samples = pipeline.finish()
    rows, made = np.concatenate([*final, samples.final]), np.concatenate([*pending, samples.pending])
    assert (pipeline.pending, len(rows)) == (0, len(made))
    assert rows["stamp_ns"].tolist() == made["stamp_ns"].tolist()
    check_samples(rows, 20_000)
    nodes += [node for accepted in apart.finish() for node in accepted.smoothed]
    nodes += apart.remaining()
    stamps_ns = np.array([n.stamp_ns for n in nodes])
    turn = np.interp(rows["stamp_ns"], stamps_ns, [n.correction[2] for n in nodes])
    assert rows["heading_rad"] - made["heading_rad"] == pytest.approx(turn, abs=1e-5)
    lever_m = vehicle.load_centre_m
    for k, (name, along) in enumerate((("x_m", np.cos), ("y_m", np.sin))):
        moved = np.interp(rows["stamp_ns"], stamps_ns, [n.correction[k] for n in nodes])
        swung = lever_m * (along(rows["heading_rad"].astype(float)) - along(made["heading_rad"].astype(float)))
        assert rows[name] - made[name] == pytest.approx(moved + swung, abs=1e-5)
    variance = np.interp(rows["stamp_ns"], stamps_ns, [n.covariance_m2[0, 0] for n in nodes])
    assert rows["cov_xx_m2"] == pytest.approx(variance, rel=1e-5)
    inner = slice(10, -10)
    assert (rows["cov_xx_m2"] + rows["cov_yy_m2"])[inner].mean() < (made["cov_xx_m2"] + made["cov_yy_m2"])[inner].mean()


@pytest.mark.slow
@pytest.mark.parametrize("seed", by_night(range(2), day=[0]))
def test_every_sample_becomes_final_whatever_happens(
    vehicle: MachineConfig, recorded: list[Reading], seed: int
) -> None:
    """Pauses, clock jumps, silence that settles all: no sample is missing or doubled."""
    rng = np.random.default_rng(seed)
    pipeline = simulated_pipeline(vehicle, lagging(float(rng.choice([1.0, 4.0, 30.0]))))
    cuts = sorted(rng.choice(len(recorded), 6).tolist())
    shift_ns, pending, final = 0, [], []
    for a, b in zip([0, *cuts], [*cuts, len(recorded)], strict=True):
        samples = [pipeline.step([replace(r, stamp_ns=r.stamp_ns + shift_ns) for r in recorded[a:b]])]
        if rng.random() < 0.5:
            samples.append(pipeline.settle())
            assert pipeline.pending == 0
        shift_ns += int(rng.choice([0, 0, 1, 6, 3600, -3600])) * SECOND
        pending += [s.pending["stamp_ns"] for s in samples]
        final += [s.final["stamp_ns"] for s in samples]
        made, done = np.concatenate(pending).tolist(), np.concatenate(final).tolist()
        assert done == made[: len(done)], f"seed={seed}"
        assert pipeline.pending == len(made) - len(done)
    end = pipeline.finish()
    assert [*done, *end.final["stamp_ns"].tolist()] == [*made, *end.pending["stamp_ns"].tolist()]
    assert len([*made, *end.pending]) > 20, f"seed={seed}"


LONG = [Leg(2), Leg(4, 0.5), *[Leg(3, 0.4), Leg(3, -0.4)] * 5]  # 36 s
FAIL_S, HEAL_S = 10.0, 22.0


def off_m(made: Drive, row: np.void) -> float:
    """Distance of a sample from the true load centre."""
    x, y, heading = made.at(int(row["stamp_ns"]))
    return math.dist((row["x_m"] - 1.5 * math.cos(heading), row["y_m"] - 1.5 * math.sin(heading)), (x, y))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "broken", "reason"), [(Encoder, {}, "no_wheels"), (Torque, {"torque_nm": 20_000.0}, "torque_frozen")]
)
def test_sensor_that_fails_costs_the_resistance_and_nothing_else(
    kind: type[Reading], broken: dict[str, float], reason: str
) -> None:
    """Places and gradients continue; the reason is counted, reported while it lasts, then resistance returns."""
    made = drive(LONG, VEHICLE, ground=Ground(0.05, 0.1))
    readings = [
        replace(r, **broken) if isinstance(r, kind) and FAIL_S < seconds(r) < HEAL_S else r  # type: ignore[arg-type]
        for r in thinned(made.readings, 20)
        if broken or not (isinstance(r, kind) and FAIL_S < seconds(r) < HEAL_S)
    ]
    pipeline = Pipeline(SITE, VEHICLE, STARTED)
    samples = [pipeline.step([r for r in readings if seconds(r) < HEAL_S - 1]).pending]
    fault = pipeline.health()["ground"]["fault"]
    samples += [pipeline.step([r for r in readings if seconds(r) >= HEAL_S - 1]).pending, pipeline.finish().pending]
    rows = np.concatenate(samples)
    assert fault == reason
    check_samples(rows, SITE.extent_m)
    at_s = (rows["stamp_ns"] - START_NS) * 1e-9
    failed = rows[(at_s > FAIL_S + 4) & (at_s < HEAL_S)]
    assert len(failed) == pytest.approx(2 * (HEAL_S - FAIL_S - 4) * 2.6, rel=0.2)  # one per 0.5 m at 2.6 m/s
    assert failed["distance_m"].sum() == pytest.approx((HEAL_S - FAIL_S - 4) * 2.6, rel=0.15)
    assert np.isnan(failed["c_rr"]).all()
    slope = np.hypot(failed["grade_e"], failed["grade_n"])
    assert slope == pytest.approx(math.tan(0.1), abs=0.08 if reason == "no_wheels" else 0.02)
    assert max(off_m(made, row) for row in failed) < 2.5
    assert pipeline.health()["without_resistance"][reason] >= len(failed) - 2
    back = rows[at_s > HEAL_S + 5]
    assert np.isfinite(back["c_rr"]).sum() > 20
    assert np.nanmedian(back["c_rr"]) == pytest.approx(0.05, abs=0.006)
    assert pipeline.health()["ground"]["fault"] == ""


# --- the end ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_finish_gives_what_still_waits_and_counts_what_has_no_place() -> None:
    pipeline = Pipeline(SITE, VEHICLE, STARTED)
    rows = pipeline.step(thinned(drive(S_BEND, VEHICLE).readings)).pending
    rest = pipeline.finish().pending
    assert len(rest) == pytest.approx(2.0 * 2.0 / 0.5, abs=2)  # the lag at 2 m/s
    assert rest["stamp_ns"][0] > rows["stamp_ns"][-1]
    assert not any(map(len, pipeline.finish()))
    unaligned = Pipeline(SITE, VEHICLE, PipelineConfig())
    assert not any(map(len, unaligned.step(thinned(drive(S_BEND, VEHICLE, without=("gps-1",)).readings))))
    assert not any(map(len, unaligned.finish()))
    assert unaligned.health()["withheld"]["no_pose"] > 90


@pytest.mark.slow
def test_calibration_is_handed_over_a_pause_and_to_the_next_pipeline() -> None:
    known = Calibration(0.004, 0.02, ((1e-7, 0.0), (0.0, 1e-5)), START_NS - 10**9, 80)
    vehicle, made = VEHICLE, thinned(drive([*S_BEND, Leg(8), *S_BEND[2:]], VEHICLE).readings)
    pipeline = Pipeline(SITE, vehicle, PipelineConfig(), known)
    pipeline.step([r for r in made if seconds(r) < 10 or seconds(r) > 20])
    assert pipeline.health()["counters"]["gap_restarts"] == 1
    assert pipeline.calibration.passages >= 80
    assert pipeline.health()["ground"]["calibration"]["zero"] == pytest.approx(0.004, abs=1e-3)
    assert Pipeline(SITE, vehicle, PipelineConfig(), pipeline.calibration).calibration.zero == pipeline.calibration.zero


@pytest.mark.parametrize(("std_m", "c_rr"), [(1.0, 0.04), (3.0, None)])
def test_known_ground_has_to_be_all_around_an_unsure_position(std_m: float, c_rr: float | None) -> None:
    """8 m inside its edge: 3 m plus twice the std."""
    pad = KnownGround("pad", 0.04, ((0.0, 0.0), (40.0, 0.0), (40.0, 40.0), (0.0, 40.0)))
    pipeline = Pipeline(replace(SITE, known_ground=(pad,)), VEHICLE, PipelineConfig())
    pipeline.positioning.poses.append(PoseBelief(START_NS, 8.0, 20.0, 0.0, 2.0, std_m**2 * np.eye(2)))
    assert pipeline._known_c_rr() == c_rr


# --- never sees the truth --------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_samples_do_not_depend_on_the_truth(tmp_path: Path) -> None:
    """Two recordings of a drive, the truth of one shifted by 100 m."""
    config = SimConfig(world="fast", machines=1, seed=5, seconds=20.0)
    samples: list[bytes] = []
    for name in ("a", "b"):
        record(config, tmp_path / name / "logs", tmp_path / name / "truth")
        if name == "b":
            move_truth(tmp_path / name / "truth", 100.0)
        log = open_log(tmp_path / name / "logs" / "loader-1")
        pipeline = Pipeline(log.site, log.machine, PipelineConfig())
        made = [pipeline.step(list(log.readings())), pipeline.finish()]
        samples.append(joined(made).pending.tobytes())
    tracks = [(tmp_path / n / "truth/tracks/loader-1.csv").read_bytes() for n in ("a", "b")]
    assert tracks[0] != tracks[1]
    assert samples[0] == samples[1]
    assert len(samples[0]) > 1000


def move_truth(folder: Path, by_m: float) -> None:
    for path in folder.rglob("*.csv"):
        with path.open(newline="") as text:
            rows = list(csv.DictReader(text))
        with path.open("w", newline="") as text:
            writer = csv.DictWriter(text, rows[0])
            writer.writeheader()
            writer.writerows({**row, "x": float(row["x"]) + by_m, "y": float(row["y"]) + by_m} for row in rows)


def test_no_reading_carries_truth() -> None:
    names = {name for kind in KINDS for name in columns(kind)}
    assert not [n for n in names if "true" in n or "truth" in n]
    # simulator-only names
    assert not names & {"x_m", "y_m", "yaw_rad", "heading_rad", "c_rr", "grade_e", "grade_n", "slip"}


# --- sensor options handled by the pipeline --------------------------------------------------------------------------


@pytest.mark.nightly
@pytest.mark.slow
def test_sensor_that_is_not_used_is_as_if_it_were_not_there(vehicle: MachineConfig, recorded: list[Reading]) -> None:
    unused = run(changed_sensor(vehicle, "gps-2", use=False), recorded)
    without = replace(vehicle, sensors=tuple(s for s in vehicle.sensors if s.name != "gps-2"))
    assert unused[:2] == run(without, [r for r in recorded if r.sensor != "gps-2"])[:2]


@pytest.mark.slow
@pytest.mark.parametrize(("delay_s", "sensors"), by_night([(0.02, ""), (-3.0, "gps-1")], day=[(-3.0, "gps-1")]))
def test_sensors_whose_stamps_are_off_by_their_delay_are_as_ones_in_time(
    vehicle: MachineConfig, recorded: list[Reading], base: Base, delay_s: float, sensors: str
) -> None:
    """Also stamps early beyond every window: readings come at the true time."""
    off = [
        replace(r, stamp_ns=r.stamp_ns + round(delay_s * SECOND)) if r.sensor.startswith(sensors) else r
        for r in recorded
    ]
    delayed = [replace(s, delay_s=delay_s) if s.name.startswith(sensors) else s for s in vehicle.sensors]
    assert run(replace(vehicle, sensors=tuple(delayed)), off) == base


@pytest.mark.slow
def test_fixes_far_from_the_site_are_refused_and_counted() -> None:
    """A receiver without a fix states the equator; such fixes would spoil the heading."""
    made = drive(S_BEND, VEHICLE)
    lost = [
        replace(r, lat_deg=0.0, lon_deg=0.0) if isinstance(r, Gps) and seconds(r) < 5.1 else r
        for r in thinned(made.readings)
    ]
    pipeline = Positioning(SITE, VEHICLE, PipelineConfig())
    pipeline.step(lost)
    assert pipeline.counters["fix_outside_site"] == 25
    assert made.off_m(pipeline.pose) < 0.5


@pytest.mark.slow
def test_a_proven_heading_that_fixes_refute_is_found_anew() -> None:
    """A crane turns the machine at 45 s with a dead gyro."""
    made = drive([Leg(4, 1.5), Leg(56)], VEHICLE)
    about, turn_rad, readings = complex(*made.at(START_NS + 45 * SECOND)[:2]), 1.5, []
    for r in thinned(made.readings):
        if isinstance(r, Gps) and seconds(r) > 45:
            x, y, z = PROJECTION.to_map(r.lat_deg, r.lon_deg, r.height_m)
            turned = about + (complex(x, y) - about) * np.exp(1j * turn_rad)
            lat, lon, _ = PROJECTION.to_geodetic(turned.real, turned.imag, z)
            r = replace(r, lat_deg=lat, lon_deg=lon)
        readings.append(r)
    pipeline = Positioning(SITE, VEHICLE, PipelineConfig(LocalisationConfig("ekf")))
    pipeline.step(readings)
    assert pipeline.counters["heading_refuted"] == 1
    assert pipeline.pose.heading_rad == pytest.approx(0.7 + turn_rad, abs=0.1)


@pytest.mark.slow
def test_a_receiver_that_counts_from_its_first_fix_may_be_anywhere() -> None:
    vehicle = changed_sensor(VEHICLE, "gps-1", mode="differential")
    made = drive((Leg(4, 0.5), Leg(4)), vehicle)
    far = [replace(r, lat_deg=r.lat_deg - 2.0) if isinstance(r, Gps) else r for r in made.readings]
    pipeline = Positioning(SITE, vehicle, PipelineConfig(LocalisationConfig(start=START)))
    pipeline.step(far)
    assert "fix_outside_site" not in pipeline.counters
    assert pipeline.counters["gps-1_used"] > 20


# --- the smoothed track ----------------------------------------------------------------------------------------------


def node(second: int, correction: tuple[float, float, float], variance_m2: float = 0.5) -> SmoothedPose:
    covariance_m2 = np.diag([variance_m2, 2 * variance_m2])
    return SmoothedPose(second * SECOND, 0.0, 0.0, 0.0, covariance_m2, np.array(correction), np.zeros((3, 15)))


def filtered(at_s: float, heading_rad: float = 0.0) -> PoseBelief:
    return PoseBelief(round(at_s * SECOND), 10.0, 20.0, heading_rad, 3.0, np.diag([4.0, 8.0]))


def test_a_correction_is_interpolated_between_nodes_and_waits_for_the_one_behind_it() -> None:
    track, second = SmoothedTrack(), node(2, (3.0, 0.0, 0.3), 1.5)
    assert track.corrected(filtered(0)) is None
    assert track.corrected_by_now(filtered(0), ()).x_m == 10.0
    track.append([node(1, (1.0, -2.0, 0.1), 0.5)])
    assert track.corrected(filtered(0.5)).x_m == 11.0, "what came before the first node is corrected as that"
    assert track.corrected(filtered(1.25)) is None
    assert track.corrected_by_now(filtered(9), [second]).x_m == 13.0
    assert track.corrected(filtered(1.25)) is None, "what remains is not final"
    track.append([second])
    smoothed = track.corrected(filtered(1.25, math.pi - 0.05))
    assert (smoothed.x_m, smoothed.y_m, smoothed.heading_rad) == pytest.approx((11.5, 18.5, 0.1 - math.pi))
    assert smoothed.covariance_m2 == pytest.approx(np.diag([0.75, 1.5]))
    assert [track.corrected(filtered(at_s)).x_m for at_s in (1, 2)] == [11.0, 13.0]


@pytest.mark.parametrize("at_once", [False, True])
def test_nodes_are_kept_until_their_poses_were_corrected_and_no_longer(at_once: bool) -> None:
    """Also after a late alignment, with minutes of nodes and samples in one step."""
    track, nodes = SmoothedTrack(), [node(second, (float(second), 0.0, 0.0)) for second in range(600)]
    for some in [nodes] if at_once else [[one] for one in nodes]:
        track.append(some)
    oldest_s = 3 if at_once else 600 - KEPT_NS // SECOND
    assert track.corrected(filtered(oldest_s)).x_m == pytest.approx(10.0 + oldest_s)
    assert at_once or len(track._nodes) <= KEPT_NS // SECOND + 2
