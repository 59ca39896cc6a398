import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.dead_reckoning import DeadReckonedPose, DeadReckoning, WheelSpeed
from agents.localisation.filters.motion import map_from_base
from agents.localisation.filters.state import YAW_RATE, Layout
from agents.localisation.headings import UNKNOWN_STD, rpy_of_base
from agents.localisation.imu_steps import FilterStep, ImuMean, StepGatherer, Turn
from agents.localisation.motion_sensors import REST_S, STANDSTILL_S, MotionSensors
from agents.localisation.tuning import TUNING
from agents.stream_order import by_stamp
from protocol.arrays import Floats
from protocol.machine.machine_config import FRONT, MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Articulation, Attitude, Encoder, Imu, Odometry, Reading
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.drives import START_NS

MS = 1_000_000
WHEELS, TORQUE = SensorConfig("wheels", "encoder"), SensorConfig("torque", "torque")
MOUNTS = [(180.0, 0.0, 0.0), (20.0, -35.0, 110.0)]


def gather(gatherer: StepGatherer, vehicle: MachineConfig, readings: Iterable[Reading]) -> list[FilterStep]:
    dead_reckoning, steps = DeadReckoning(vehicle, 0.0), []
    for group in by_stamp(readings):
        sensed = [(reading, vehicle.sensor(reading.sensor)) for reading in group]
        for reading, sensor in sensed:
            dead_reckoning.update(reading, sensor)
        step = gatherer.gather(sensed, dead_reckoning)
        steps += [step] if step else []
    return steps


def with_imu(
    mount: Mount | None = None, frame: str = "base_link", more: tuple[SensorConfig, ...] = ()
) -> MachineConfig:
    return MachineConfig("loader-1", sensors=(SensorConfig("imu", "imu", mount or Mount(), frame=frame), *more))


def imu(ms: float, rates: Iterable[float], force: Iterable[float] = (0.0, 0.0, GRAVITY_MPS2), name: str = "imu") -> Imu:
    return Imu(name, START_NS + round(ms * MS), *map(float, rates), *map(float, force))


def one(vehicle: MachineConfig, readings: Iterable[Reading], step_s: float = 0.1) -> FilterStep:
    (step,) = gather(StepGatherer(vehicle, step_s), vehicle, readings)
    return step


@pytest.mark.parametrize("rpy_deg", MOUNTS)
def test_a_mounted_imu_is_turned_into_base_link(rpy_deg: tuple[float, float, float]) -> None:
    mount = Mount((0.4, 0.0, 0.9), rpy_deg)
    rates, force = np.array([0.1, -0.2, 0.3]), np.array([1.0, 2.0, 9.0])
    raw = mount.frame_from_sensor().T
    step = one(with_imu(mount), [imu(t, raw @ rates, raw @ force) for t in (0, 100)])
    assert step.imu_means["imu"].rates_radps == pytest.approx(rates)
    assert step.imu_means["imu"].force_mps2 == pytest.approx(force)


def articulated(angle_rad: float, rate_radps: float, seconds: float) -> list[FilterStep]:
    """Rear frame: 0.2 rad/s, 1 m/s2 ahead; the IMU is on the front frame."""
    vehicle = with_imu(Mount((1.0, 0.0, 0.5), (0.0, 0.0, 90.0)), FRONT, (SensorConfig("joint", "articulation"),))
    readings: list[Reading] = []
    for i in range(round(seconds * 100)):
        angle = angle_rad + rate_radps * i / 100
        rear_from_sensor = map_from_base(np.array([0.0, 0.0, angle])) @ vehicle.sensors[0].mount.frame_from_sensor()
        rates, force = np.array([0.05, 0.02, 0.2]), np.array([1.0, 0.0, GRAVITY_MPS2])
        readings.append(Articulation("joint", START_NS + i * 10 * MS, angle))
        raw = rear_from_sensor.T @ (rates + np.array([0.0, 0.0, rate_radps])), rear_from_sensor.T @ force
        readings.append(imu(10 * i, *raw))
    return gather(StepGatherer(vehicle, 0.1), vehicle, readings)


@pytest.mark.parametrize(("angle_rad", "rate_radps"), [(0.6, 0.0), (-0.4, 0.2)])
def test_front_imu_is_turned_by_the_articulation_and_its_rate_taken_off(angle_rad: float, rate_radps: float) -> None:
    mean = articulated(angle_rad, rate_radps, 4.0)[-1].imu_means["imu"]
    assert mean.rates_radps == pytest.approx([0.05, 0.02, 0.2], abs=1e-3)
    assert mean.force_mps2 == pytest.approx([1.0, 0.0, GRAVITY_MPS2], abs=1e-3)


# --- attitude --------------------------------------------------------------------------------------------------------


def quaternion(rotation: Floats) -> tuple[float, ...]:
    """x, y, z, w from the matrix's trace and eigenvector of eigenvalue one."""
    values, vectors = np.linalg.eig(rotation)
    axis = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    skew = rotation - rotation.T
    sine = 0.5 * axis @ (skew[2, 1], skew[0, 2], skew[1, 0])
    half = 0.5 * math.atan2(sine, 0.5 * (np.trace(rotation) - 1))
    return (*(axis * math.sin(half)).tolist(), math.cos(half))


def attitude(rpy: Iterable[float], mount: Mount, ms: float = 0.0, scale: float = 1.0) -> Attitude:
    q = quaternion(map_from_base(np.array([*rpy])) @ mount.frame_from_sensor())
    return Attitude("ahrs", START_NS + round(ms * MS), *(scale * v for v in q), 0.01, 0.02, 0.03)


def with_ahrs(mount: Mount, frame: str = "base_link") -> MachineConfig:
    return MachineConfig("loader-1", sensors=(SensorConfig("ahrs", "attitude", mount, frame=frame), WHEELS))


@pytest.mark.parametrize("rpy_deg", MOUNTS)
@pytest.mark.parametrize("rpy", [(0.1, -0.2, 3.0), (-0.3, 0.4, -1.2)])
def test_an_attitude_becomes_roll_pitch_yaw_at_any_mount(
    rpy: tuple[float, float, float], rpy_deg: tuple[float, float, float]
) -> None:
    mount = Mount((0.0, 0.0, 1.0), rpy_deg)
    step = one(with_ahrs(mount), [attitude(rpy, mount), attitude(rpy, mount, 100, scale=-1.0005)])
    last = step.attitudes["ahrs"]
    assert rpy_of_base(last, mount.frame_from_sensor()) == pytest.approx(rpy, abs=1e-9)
    assert last.stamp_ns == step.stamp_ns


@pytest.mark.parametrize(
    ("vehicle", "readings", "counter"),
    [
        (with_imu(frame=FRONT), [imu(t, (0, 0, 1)) for t in (0, 100)], "front_imu_without_articulation"),
        (with_ahrs(Mount(), FRONT), [attitude((0, 0, 1), Mount(), t) for t in (0, 100)], "front_attitude_unused"),
        (with_ahrs(Mount()), [attitude((0, 0, 1), Mount(), t, 0.0) for t in (0, 100)], "attitude_without_direction"),
    ],
)
def test_what_shows_no_direction_of_the_rear_frame_is_counted_and_not_used(
    vehicle: MachineConfig, readings: list[Reading], counter: str
) -> None:
    steps = StepGatherer(vehicle, 0.1)
    (step,) = gather(steps, vehicle, readings)
    assert (step.imu_means, step.attitudes) == ({}, {})
    assert steps.counters == {counter: 2}


# --- wheels ----------------------------------------------------------------------------------------------------------


def test_still_since_the_last_travel() -> None:
    vehicle = MachineConfig("cart", sensors=(WHEELS,))
    ticks = [*range(20), *[20] * 40, *range(21, 31)]  # a second moving, two standing, half moving
    readings = [Encoder("wheels", START_NS + i * 50 * MS, float(t), float(t)) for i, t in enumerate(ticks)]
    still = [step.still_s for step in gather(StepGatherer(vehicle, 0.1), vehicle, readings)]
    assert still[:10] == [0.0] * 10
    assert still[10:29] == pytest.approx(np.arange(1, 20) / 10)
    assert still[30:] == [0.0] * len(still[30:])


@pytest.mark.parametrize("kind", ["encoder", "odometry"])
def test_a_step_shows_whether_wheels_were_read(kind: str) -> None:
    """Silent wheels give neither speed nor standstill; ticks give a speed once there are enough."""
    vehicle = with_imu(more=(SensorConfig("w", kind),))

    def wheels(ms: int) -> Reading:
        stamp_ns = START_NS + ms * MS
        return Encoder("w", stamp_ns, 0.0, 0.0) if kind == "encoder" else Odometry("w", stamp_ns, 0.0, 0.0, 0.0)

    readings: list[Reading] = [imu(t, (0, 0, 0)) for t in range(0, 1601, 50)]
    readings += [wheels(t) for t in (*range(20, 1121, 20), 1420)]
    shown = [s.rolled for s in gather(StepGatherer(vehicle, 0.1), vehicle, readings)]
    settling = 6 if kind == "encoder" else 0
    assert shown == [False] * settling + [True] * (12 - settling) + [False, False, True, False]


# --- from a step to measurements, deviations, gates ------------------------------------------------------------------

STEP = FilterStep(7, DeadReckonedPose(7, 0.0, 0.0, 0.0, 0.0), {}, {}, WheelSpeed(2.0, is_known=True), True, 0.1, 0.0)
FORCE = np.array([0.06 * GRAVITY_MPS2, 0.0, GRAVITY_MPS2])
IMU_STEP = replace(STEP, imu_means={"imu": ImuMean(np.zeros(3), FORCE)})


def sensors(
    *configured: SensorConfig, slip: float = 0.0, slip_soft: float = 0.0, on_plane: bool = False
) -> MotionSensors:
    machine = MachineConfig("truck", wheelbase_m=3.0, sensors=configured)
    return MotionSensors(machine, Layout(imus=1, wheel_scale=True), 10.0, (slip, slip_soft), on_plane=on_plane)


def deviations(R: Any) -> list[float]:
    return np.sqrt(np.diag(R)).tolist()  # type: ignore[no-any-return]


@pytest.mark.parametrize(
    ("options", "rate", "force"),
    [
        ({}, TUNING.rate_radps, TUNING.force_mps2),
        ({"std": {"rate": 0.1, "force": 0.5}}, 0.1, 0.5),
        ({"measures": ("rate",)}, TUNING.rate_radps, UNKNOWN_STD),
        ({"measures": ("force",)}, UNKNOWN_STD, TUNING.force_mps2),
    ],
)
def test_an_imu_is_as_sure_as_it_is_configured(options: dict[str, Any], rate: float, force: float) -> None:
    imu = SensorConfig("imu", "imu", **options)
    (measurement,) = sensors(imu).inertial(IMU_STEP)
    assert deviations(measurement.R) == pytest.approx([rate] * 3 + [force] * 3)
    assert measurement.z[3:].tolist() == FORCE.tolist()
    assert len(sensors(imu).forces(IMU_STEP)) == ("measures" not in options or "force" in options["measures"])


def test_on_a_plane_an_imu_measures_the_turn_alone() -> None:
    step = replace(IMU_STEP, imu_means={"imu": ImuMean(np.array([0.3, -0.2, 0.1]), FORCE)})
    (measurement,) = sensors(SensorConfig("imu", "imu", std={"rate": 0.1}), on_plane=True).inertial(step)
    assert (measurement.sensor, measurement.z.tolist(), deviations(measurement.R)) == ("imu", [0.1], [0.1])
    assert measurement.jacobian(np.zeros(17))[0].nonzero()[0].tolist() == [YAW_RATE, Layout(imus=1).gyro_bias(0)]
    assert sensors(SensorConfig("imu", "imu", measures=("force",)), on_plane=True).inertial(step) == []


@pytest.mark.parametrize(("gate_sigma", "expected"), [(0.0, TUNING.gate_sigma), (2.5, 2.5)])
def test_each_sensor_may_have_its_own_gate(gate_sigma: float, expected: float) -> None:
    imu, wheels = (SensorConfig(kind, kind, gate_sigma=gate_sigma) for kind in ("imu", "encoder"))
    steering = SensorConfig("steering", "steering", gate_sigma=gate_sigma)
    body = sensors(wheels, steering)
    made = [*sensors(imu).inertial(IMU_STEP), *body.wheels(STEP), *body.turn(replace(STEP, turn=Turn(0.1, 2.0)))]
    assert [m.gate_sigma for m in made] == [expected] * 3


@pytest.mark.parametrize(
    ("slip", "slip_soft", "speed_mps"), [(0.0, 0.0, 2.0), (0.2, 0.0, 2.0 * 0.98), (0.2, 1.0, 2.0 * (1 - 0.1 * 0.24))]
)
def test_slip_of_the_tyres_and_of_soft_ground_is_taken_off(slip: float, slip_soft: float, speed_mps: float) -> None:
    """Traction of a tenth of the weight: 0.06 climbing, 0.04 rolling."""
    body = sensors(SensorConfig("imu", "imu"), SensorConfig("wheels", "encoder"), slip=slip, slip_soft=slip_soft)
    (wheels,) = body.wheels(IMU_STEP)
    assert wheels.z.tolist() == pytest.approx([speed_mps, 0.0, 0.0])


def test_wheels_that_are_silent_or_without_speed_measure_nothing() -> None:
    wheels = SensorConfig("wheels", "odometry")
    assert sensors(wheels).wheels(replace(STEP, rolled=False, still_s=9.0)) == []
    assert sensors(replace(wheels, measures=("rate",))).wheels(STEP) == []
    (measurement,) = sensors(replace(wheels, std={"speed": 0.5})).wheels(STEP)
    assert deviations(measurement.R) == pytest.approx([0.5, TUNING.side_mps, TUNING.side_mps])


def test_a_machine_stands_once_its_wheels_do_not_turn_for_a_second() -> None:
    body = sensors(SensorConfig("wheels", "encoder"))
    named = [[m.sensor for m in body.wheels(replace(STEP, still_s=s))] for s in (STANDSTILL_S - 0.1, STANDSTILL_S)]
    assert named == [["wheels"], ["wheels", "standstill"]]


@pytest.mark.parametrize(("joint", "shown"), [(0.9, 6), (1.1, 3), (-1.1, 3)])
def test_while_the_joint_turns_a_standstill_shows_no_turn_rate(joint: float, shown: int) -> None:
    body = sensors(SensorConfig("wheels", "encoder"))
    _, still = body.wheels(replace(STEP, still_s=STANDSTILL_S, joint_radps=joint * TUNING.joint_radps))
    assert (len(still.z), still.jacobian(np.zeros(17)).shape, still.R.shape) == (shown, (shown, 17), (shown, shown))
    silent = replace(STEP, silent=True, still_s=REST_S, joint_radps=joint * TUNING.joint_radps)
    assert ("standstill" in [m.sensor for m in body.wheels(silent)]) == (shown == 6)


def test_joint_rate_is_that_of_a_noisy_angle_and_unknown_once_the_sensor_is_silent() -> None:
    noise, rate = np.random.default_rng(1), 0.01
    vehicle = with_imu(more=(SensorConfig("joint", "articulation"),))
    turning: list[Reading] = [
        Articulation("joint", START_NS + 50 * i * MS, 0.05 * i * rate + noise.normal(0, 0.0035)) for i in range(400)
    ]
    steps = gather(
        StepGatherer(vehicle, 0.05), vehicle, [*turning, *(imu(t, np.zeros(3)) for t in range(0, 25_000, 50))]
    )
    rates = np.array([step.joint_radps for step in steps])
    assert np.abs(rates[100:398] - rate).max() < 0.0045  # four deviations of 0.06 deg/s
    assert set(rates[-50:]) == {0.0}


def test_a_turn_without_any_source_is_counted() -> None:
    blind = sensors(SensorConfig("wheels", "encoder"))
    assert blind.turn(STEP) == []
    assert blind.counters == {"turn_unknown": 1}
    assert blind.turn_error_radps == 0.0
    stated = sensors(SensorConfig("odometry", "odometry", std={"rate": 0.3}))
    (turn,) = stated.turn(replace(STEP, turn=Turn(0.1, 1.0)))
    assert (deviations(turn.R), stated.turn_error_radps) == ([0.3], 0.3)
    assert not stated.counters
