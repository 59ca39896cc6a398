from dataclasses import replace
from typing import Any

import pytest

from agents.holdout import FIGURES, Holdout, HoldoutConfig
from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Gps, GpsVelocity, Reading
from tests.unit.agents.drives import S_BEND, SITE, Drive, changed_sensor, drive, fix, machine, thinned

CONFIG, SETTLE_S = HoldoutConfig(period_s=5.0, off_s=1.0), 10.0
CHEAP = PipelineConfig(LocalisationConfig(filter="ekf"))


@pytest.fixture(scope="module")
def vehicle() -> MachineConfig:
    return machine()


@pytest.fixture(scope="module")
def made(vehicle: MachineConfig) -> Drive:
    made = drive(S_BEND, vehicle)
    return replace(made, readings=thinned(made.readings))


def run(
    vehicle: MachineConfig, readings: list[Reading], config: HoldoutConfig = CONFIG, settle_s: float = SETTLE_S
) -> tuple[Pipeline, Any]:
    pipeline, holdout = Pipeline(SITE, vehicle, CHEAP), Holdout(SITE, vehicle, config, settle_s)
    for i in range(0, len(readings), 50):
        pipeline.step(holdout.split(readings[i : i + 50]))
        holdout.compare(pipeline)
    return pipeline, holdout.report()


@pytest.mark.slow
def test_withheld_fixes_never_reach_the_pipeline(vehicle: MachineConfig, made: Drive) -> None:
    """A far-off withheld fix would show in the poses, a used one in the counters."""
    holdout = Holdout(SITE, vehicle, CONFIG)
    seen = holdout.split(made.readings)
    withheld = set(made.readings) - set(seen)
    assert len(withheld) == 30
    assert all(isinstance(r, Gps) for r in withheld)
    assert {r.sensor for r in seen} == {"imu", "torque", "wheels", "gps-1"}
    moved = [replace(r, lat_deg=r.lat_deg + 0.001) if r in withheld else r for r in made.readings]
    pipelines = [run(vehicle, readings)[0] for readings in (made.readings, moved)]
    assert pipelines[0].health() == pipelines[1].health()
    assert pipelines[0].pose.x_m == pipelines[1].pose.x_m
    assert not any("gated" in name for name in pipelines[1].health()["counters"])


@pytest.mark.slow
def test_errors_are_right_on_a_made_up_case(vehicle: MachineConfig, made: Drive) -> None:
    off_m = 3.0
    gps = vehicle.sensors[-1]
    readings: list[Reading] = []
    for r in made.readings:
        x, y, heading = made.at(r.stamp_ns)
        first = (r.stamp_ns - made.readings[0].stamp_ns) * 1e-9
        is_off = isinstance(r, Gps) and first % 5.0 < 1.0
        readings.append(fix(gps, r.stamp_ns, x + 0.6 * off_m, y - 0.8 * off_m, heading) if is_off else r)
    _, report = run(vehicle, readings)
    assert report["fixes"] == 20  # 5 Hz for 1 s in 5, from 10 to 30 s
    assert report["rms_m"] == pytest.approx(off_m, abs=0.5)
    assert report["median_m"] == pytest.approx(off_m, abs=0.5)
    none = {"fixes": 0, **dict.fromkeys(FIGURES)}
    assert run(vehicle, made.readings[:100])[1] == none
    assert report["expected_rms_m"] == pytest.approx(off_m, abs=1.0)  # never believed before


@pytest.mark.slow
def test_fixes_are_compared_with_the_poses_of_when_they_were_true(vehicle: MachineConfig, made: Drive) -> None:
    delay_s = 0.3
    shift = round(delay_s * 1e9)
    readings = [replace(r, stamp_ns=r.stamp_ns + shift) if isinstance(r, Gps) else r for r in made.readings]
    reports = [
        run(v, r)[1]
        for v, r in ((vehicle, made.readings), (changed_sensor(vehicle, "gps-1", delay_s=delay_s), readings))
    ]
    assert reports[1]["rms_m"] == pytest.approx(reports[0]["rms_m"], abs=0.1)  # it moves 0.6 m meanwhile


def test_velocities_are_withheld_with_the_fixes_and_judged_by_nobody(made: Drive) -> None:
    vehicle = machine()
    doppler = SensorConfig("doppler", "gps_velocity")
    vehicle = replace(vehicle, sensors=(*vehicle.sensors, doppler))
    velocities = [GpsVelocity("doppler", r.stamp_ns, 0.0, 0.0, 1.0, 1.0) for r in made.readings if isinstance(r, Gps)]
    readings = sorted([*made.readings, *velocities], key=lambda r: r.stamp_ns)
    holdout = Holdout(SITE, vehicle, CONFIG)
    seen = holdout.split(readings)
    stamps = [{r.stamp_ns for r in seen if r.sensor == name} for name in ("doppler", "gps-1")]
    assert stamps[0] == stamps[1]
    assert len(readings) - len(seen) == 60
    assert holdout.report()["fixes"] == 0


@pytest.mark.parametrize(("name", "value"), [("period_s", 1.0), ("off_s", 0.0)])
def test_bad_holdout_option_is_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        HoldoutConfig(**{name: value})
