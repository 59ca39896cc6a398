"""A golden drive per vehicle: the pipeline's figures against recorded ones, to notice any change.

After an intended change `python -m tests.unit.agents.test_golden_drives` records the figures of all or the named
drives; the file's difference shows the effect.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from agents.estimation.calibration import Calibration
from agents.estimation.ground import EstimationConfig
from agents.localisation.localiser import LocalisationConfig
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import joined
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Gps, Imu, Reading, Torque
from protocol.machine.samples import check_samples
from protocol.site.site_config import KnownGround, SiteConfig
from tests.unit.agents.drives import (
    SITE,
    START,
    START_NS,
    VEHICLE,
    Ground,
    Leg,
    after,
    changed_sensor,
    drive,
    machine,
    moved,
    noisy,
    simulated,
    with_ahrs,
)
from tests.unit.agents.localisation import test_foreign_logs as carts
from tests.unit.agents.localisation import test_gps as doppler
from tests.unit.agents.localisation import test_turns as trucks

FIGURES = Path(__file__).with_name("golden_drives.json")
TOUR = (Leg(3), Leg(4, 0.5), Leg(4), Leg(4, 0.0, 0.25), Leg(5), Leg(4, 0.0, -0.3), Leg(4), Leg(4, -0.5), Leg(4))
SLOPE = Ground(0.05, 0.08, 0.04)
Case = tuple[SiteConfig, MachineConfig, Sequence[Reading], PipelineConfig]


def config(engine: str = "ekf", *, lag_s: float = 5.0, estimation: Any = None, **options: Any) -> PipelineConfig:
    return PipelineConfig(LocalisationConfig(engine, lag_s=lag_s, **options), estimation or EstimationConfig())


def loader(seconds: float = 42.0, **options: Any) -> Case:
    """All options of a simulated loader, with outliers, a pause of 2 s and a late fix."""
    site, vehicle, readings, _ = simulated(3, 42.0, gps=(1, 2), imu=(1, 3), attitude=(3,), payload=True)
    troubled = [r for r in moved(readings, 60.0, from_s=34, to_s=36) if not after(r, 38) or after(r, 40)]
    late = next(i for i, r in enumerate(troubled) if isinstance(r, Gps) and after(r, 33))
    troubled.insert(late + 60, troubled.pop(late))
    troubled = [r for r in troubled if not after(r, seconds)]
    return site, vehicle, troubled, config(start=(29.143, 18.503, -0.339), **options)


def receivers() -> Case:
    """Three with shared errors: one drifts off and returns; wheels overcount, then fall silent."""
    vehicle = machine(receivers=3)
    readings = moved(noisy(drive(TOUR, vehicle, ground=SLOPE).readings, 2), 30.0, "gps-2", from_s=20, to_s=26)
    wheels = [
        replace(r, left_ticks=1.05 * r.left_ticks, right_ticks=1.05 * r.right_ticks) if isinstance(r, Encoder) else r
        for r in readings
        if not isinstance(r, Encoder) or not 28 < (r.stamp_ns - START_NS) * 1e-9 < 31
    ]
    return SITE, vehicle, wheels, config("ukf", start=START)


def modes(profile: str) -> Case:
    """Beside an absolute receiver a relative one, far off and late, and a differential one; likewise an AHRS."""
    vehicle = changed_sensor(machine(receivers=3), "gps-2", mode="relative", std={"position": 1.5})
    vehicle = changed_sensor(vehicle, "gps-3", mode="differential")
    ahrs = SensorConfig("ahrs", "attitude", mode="relative" if profile == "default" else "differential")
    vehicle = replace(vehicle, sensors=(*vehicle.sensors, ahrs))
    readings = noisy(with_ahrs(drive(TOUR, vehicle, ground=SLOPE), 1.0), 3)
    off = moved(readings, 500.0, "gps-2")
    arriving = sorted(off, key=lambda r: r.stamp_ns + (400_000_000 if r.sensor in ("gps-2", "ahrs") else 0))
    return SITE, vehicle, arriving, config("ukf" if profile == "default" else "ekf", profile=profile, start=START)


def body() -> Case:
    """Articulated, weighing, on tyres and known ground; only GPS gives its start."""
    bodied = machine(wheelbase_m=3.3, axle_stiffness_npm=1.8e6, cog_height_m=1.05, payload_x_m=4.7, payload_z_m=0.85)
    more = SensorConfig("joint", "articulation"), SensorConfig("scale", "payload")
    vehicle = replace(bodied, sensors=(*bodied.sensors, *more))
    work = (Leg(4, 0.5), Leg(5, payload_kg=3000), Leg(4, -0.5), Leg(2), Leg(4, -0.5), Leg(5, bend_rad=0.3), Leg(4, 0.5))
    pad = KnownGround("pad", 0.05, ((-80.0, -80.0), (120.0, -80.0), (120.0, 120.0), (-80.0, 120.0)))
    readings = noisy(drive((Leg(2), *work, *work[:4]), vehicle, ground=SLOPE).readings, 4, torque=1.03)
    return replace(SITE, known_ground=(pad,)), vehicle, readings, config(slip=0.1, slip_soft=0.2)


def faulty() -> Case:
    """Stuck torque, a repeating receiver, an accelerometer in g."""
    made = noisy(drive([Leg(2), Leg(4, 0.5), *[Leg(3, 0.6), Leg(3, -0.6)] * 6], VEHICLE, ground=SLOPE).readings, 5)
    kept, readings = next(r for r in made if isinstance(r, Gps) and after(r, 22)), []
    for r in made:
        if isinstance(r, Torque) and after(r, 10) and not after(r, 18):
            r = replace(r, torque_nm=9000.0)
        elif isinstance(r, Gps) and after(r, 22) and not after(r, 30):
            r = replace(kept, stamp_ns=r.stamp_ns)
        elif isinstance(r, Imu) and after(r, 36):
            r = replace(r, force_x_mps2=r.force_x_mps2 / 9.81, force_z_mps2=r.force_z_mps2 / 9.81)
        readings.append(r)
    return SITE, VEHICLE, readings, config(start=START)


def truck(*sensors: SensorConfig) -> Case:
    """No IMU: turn rate from steering or odometry, both with errors."""
    vehicle = trucks.truck(*sensors)
    wrong = trucks.Wrong(steering_rad=0.02, rate_radps=0.01)
    made = trucks.driven(vehicle, wrong, [Leg(6, 0.5), Leg(8), Leg(12, 0, 0.25), Leg(12, 0, -0.25)], seed=1)
    return SITE, vehicle, made.readings, config("ukf", slip=0.0, slip_soft=0.0)


def cart() -> Case:
    """Starts in motion, 10 Hz: gyro without accelerometer, odometry, an encoder at the side."""
    left = SensorConfig("left", "encoder", Mount((0.0, 0.7, 0.0)))
    vehicle = carts.cart(carts.GYRO, carts.ODOMETRY, left, carts.GPS)
    made = drive(carts.TOUR[:5], vehicle)
    return SITE, vehicle, carts.readings_of(vehicle, made, 10, seed=1, from_s=5.0), config("ukf")


def with_doppler() -> Case:
    """Doppler shows the wheel scale and holds the position without fixes."""
    made = drive(TOUR, doppler.WITH_DOPPLER)
    velocities = doppler.doppler(made, seed=3, std_mps=0.1)
    blind = doppler.silenced(doppler.larger_wheels(noisy(made.readings, 6), 1.08), 30.0)
    return SITE, doppler.WITH_DOPPLER, doppler.merged(blind, velocities), config(start=START)


CASES: dict[str, Callable[[], Case]] = {
    "loader, ukf": lambda: loader(engine="ukf"),
    "loader, rls and mass, no lag": lambda: loader(lag_s=0.0, estimation=EstimationConfig("rls", "estimated")),
    "loader, paper ekf": lambda: loader(profile="paper"),
    "loader, paper ukf, known mass": lambda: loader(
        10.0, engine="ukf", profile="paper", estimation=EstimationConfig(mass="known")
    ),
    "receivers": receivers,
    "modes": lambda: modes("default"),
    "modes, paper": lambda: modes("paper"),
    "body": body,
    "faulty": faulty,
    "truck, steering": lambda: truck(trucks.ENCODER, trucks.STEERING),
    "truck, odometry": lambda: truck(trucks.ODOMETRY),
    "cart": cart,
    "doppler": with_doppler,
}
ROWS, DIGITS = 6, 8
AT_NIGHT = ("loader, paper ekf", "modes", "modes, paper")  # the profile has a day drive, modes have tests


def figures(case: Case) -> dict[str, Any]:
    """Some pending and final samples, the last belief, all of health."""
    site, vehicle, readings, options = case
    known = Calibration(0.003, 0.01, ((4e-6, 0.0), (0.0, 4e-4)), START_NS - 10**9, 80)
    pipeline = Pipeline(site, vehicle, options, known)
    made = [pipeline.step(readings[i : i + 500]) for i in range(0, len(readings), 500)]
    positioning, health = pipeline.positioning, pipeline.health()
    belief = positioning.localiser.belief
    assert belief
    samples = joined([*made, pipeline.finish()])
    table: dict[str, Any] = {"health": health, "x": belief.x.tolist(), "std": np.sqrt(np.diag(belief.P)).tolist()}
    for name, rows in (("pending", samples.pending), ("final", samples.final)):
        check_samples(rows, 20_000)
        assert (np.diff(rows["stamp_ns"]) > 0).all()
        some = rows[np.linspace(0, len(rows) - 1, ROWS).astype(int)]
        table[name] = {column: some[column].tolist() for column in rows.dtype.names} | {"count": len(rows)}
    return dict(flat(table))


def flat(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Its leaves by path."""
    if isinstance(value, dict):
        for name in sorted(value):
            yield from flat(value[name], f"{path}.{name}".lstrip("."))
    elif isinstance(value, list | tuple):
        for i, item in enumerate(value):
            yield from flat(item, f"{path}[{i}]")
    else:
        yield path, float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value


def differs(one: Any, other: Any) -> bool:
    if isinstance(one, float) and isinstance(other, float):
        return not math.isclose(one, other, rel_tol=1e-5, abs_tol=1e-7) and not (math.isnan(one) and math.isnan(other))
    return bool(one != other)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.nightly] * (name in AT_NIGHT)) for name in CASES]
)
def test_a_drive_gives_the_figures_that_it_gave(name: str) -> None:
    expected, given = json.loads(FIGURES.read_text(encoding="utf-8"))[name], figures(CASES[name]())
    assert given.keys() == expected.keys()
    different = {path: (expected[path], value) for path, value in given.items() if differs(expected[path], value)}
    assert not different, f"{len(different)} of {len(given)} figures, the first: {list(different.items())[:8]}"


if __name__ == "__main__":
    taken = json.loads(FIGURES.read_text(encoding="utf-8")) if FIGURES.exists() else {}
    taken |= {name: figures(CASES[name]()) for name in sys.argv[1:] or CASES}
    FIGURES.write_text(json.dumps(taken, indent=0) + "\n", encoding="utf-8")
