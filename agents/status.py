"""What hinders an agent, the worst first, in sentences: for its terminal, its log, its health, the doctor and the page.

A hindrance is a problem where somebody has to mend something. Else it passes, or is how the machine is equipped.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from agents.localisation.alignment import DISTANCE_M
from agents.localisation.localiser import PROVEN_S, UNSIGNED_M
from agents.sampling import MAX_STD_M
from protocol.machine.clock_watch import GAP_NS
from protocol.machine.machine_config import DRIVES, MachineConfig, SensorConfig
from protocol.machine.readings import Encoder, Engine, Gps, GpsVelocity, Imu, Odometry, Reading
from protocol.machine.samples import ZERO_STD

WAIT_NS = 30 * 10**9  # in the readings' time; a machine that drives off has its heading after 10 to 20 s
SILENT_S = 10.0  # without a reading: sensors send each second
CALIBRATED = 0.5  # of the accelerometer's first uncertainty: some metres in both directions, or a closed loop
REFERENCE_OFF, SURE = 0.05, 3.0  # a scale of the torque beyond it is a wrong data sheet; standard deviations
UNIT = 1.5  # no tyre is so far off: wheels that turn so much further or less far than the fixes go have another unit
WHEELS = frozenset({Encoder.kind, Odometry.kind})
SPEEDS = WHEELS | {GpsVelocity.kind}
NEEDED = {Imu.kind: "force", Odometry.kind: "speed"}
DRAWS = "rolling resistance and slope go to the map"
GROUND = {  # faults of sensors, by the ground estimator's reason
    "no_imu": "no accelerations: track only",
    "no_wheels": "no wheel speeds: slope only",
    "no_torque": "no torque: slope only",
    "torque_frozen": "torque repeats one value: slope only; look at its sensor",
    "torque_implausible": "torque does not fit the motion: slope only; look at its unit and sign",
    "accelerometer": "accelerations are none of a machine on the ground: track only; look at unit and mount",
}


class Hindrance(NamedTuple):
    """Why samples are missing, wait or lack something."""

    sentence: str
    is_problem: bool = True


class Status:
    """Follows a machine's readings, and judges its report. unsampled: why it has no sample, once that is sure."""

    def __init__(self, machine: MachineConfig) -> None:
        self.unsampled = ""
        self._sensors = {sensor.name: sensor for sensor in machine.sensors if sensor.use}
        self._kinds: set[str] = set()  # of the readings of the machine's own sensors
        self._spans_ns: dict[str, tuple[int, int]] = {}  # of each sensor's readings, by its own clock, since a gap
        self._is_sampled = False

    @property
    def heard(self) -> list[str]:
        """Sensors of the machine that had a reading."""
        return sorted(self._spans_ns.keys() & self._sensors.keys())

    def take(self, readings: Sequence[Reading]) -> None:
        """Take in readings. The time counts from the first one behind a gap, as localisation starts anew there."""
        for reading in readings:
            if (sensor := self._sensors.get(reading.sensor)) and sensor.kind == reading.kind:
                self._kinds.add(shown(sensor))
            first_ns, newest_ns = self._spans_ns.get(reading.sensor, (reading.stamp_ns, reading.stamp_ns))
            is_on = abs(reading.stamp_ns - newest_ns) <= GAP_NS
            self._spans_ns[reading.sensor] = (first_ns if is_on else reading.stamp_ns), reading.stamp_ns

    def sampled(self) -> None:
        """Note that there is a sample, pending or final."""
        self._is_sampled, self.unsampled = True, ""

    def judge(self, report: Mapping[str, Any]) -> list[Hindrance]:
        """All that hinders the agent now, the worst first. report: of the agent, in plain values."""
        hindrances = [*self._of_places(report), *_of_delivery(report), *_of_sensors(report), *self._of_ground(report)]
        return list(dict.fromkeys(hindrances))

    def _of_places(self, report: Mapping[str, Any]) -> Iterator[Hindrance]:
        """Why there is no sample, or none for a while."""
        drivers, silent_s = [Hindrance(problem) for problem in report["driver_problems"]], report["silent_s"]
        if not self._spans_ns or silent_s > SILENT_S:
            yield from drivers
            stopped = f"no readings for {silent_s:.0f} s: is the machine off?"
            yield Hindrance(stopped if self._spans_ns else "waiting for the first readings", is_problem=False)
            return
        if self._is_sampled:
            if (report["pipeline"]["position_std_m"] or 0.0) > MAX_STD_M:
                yield Hindrance(f"samples are withheld: the position is less certain than {MAX_STD_M:g} m")
            return
        if Gps.kind not in self._kinds:
            yield from drivers
        waited_ns = max(newest_ns - first_ns for first_ns, newest_ns in self._spans_ns.values())
        state = report["pipeline"]
        proof_ns = round(PROVEN_S * 1e9) if state["aligned"] and not state["heading_proven"] else 0
        causes = [report["clocks"]] if report["clocks"] else self._missing(state)
        is_sure = waited_ns >= WAIT_NS + proof_ns
        self.unsampled = f"no sample after {waited_ns // 10**9} s of readings: {', '.join(causes)}" if is_sure else ""
        yield Hindrance(f"no sample yet: {', '.join(causes)}", is_sure)

    def _missing(self, state: Mapping[str, Any]) -> list[str]:
        """Why no sample can be made. state: health of the pipeline."""
        if not self._kinds:
            return ["no reading is of a sensor in the config"]
        if state["heading_proven"]:
            unsure = state["withheld"].get("unsure_position")
            return [f"the position is less certain than {MAX_STD_M:g} m" if unsure else "the machine has not moved"]
        if Gps.kind not in self._kinds:
            return ["no GPS fixes"]
        if state["counters"].get("fix_outside_site"):
            return ["GPS fixes are outside the site"]
        if state["repeating"]:
            return [f"{', '.join(state['repeating'])} repeats one fix"]
        if not state["aligned"]:
            return [self._to_align()]
        turned = 1 + (state["wheel_scale"] or 0.0)
        if WHEELS & self._kinds and not 1 / UNIT < turned < UNIT:
            return [f"the wheels turn {turned:.1f} times as far as the fixes go: look at their unit"]
        return [f"the heading is not proven until fixes agree with it for {PROVEN_S:g} s and {DISTANCE_M:g} m"]

    def _to_align(self) -> str:
        """What the heading takes."""
        is_blind = not WHEELS & self._kinds and Imu.kind in self._kinds
        distance_m = UNSIGNED_M if is_blind else DISTANCE_M
        lacks = "" if SPEEDS & self._kinds else "no wheel speeds and no Doppler velocity: "
        return f"{lacks}the heading is unknown until the machine has driven {distance_m:g} m with GPS fixes"

    def _of_ground(self, report: Mapping[str, Any]) -> Iterator[Hindrance]:
        """What samples lack."""
        ground = report["pipeline"]["ground"]
        needed = {"accelerations": {Imu.kind}, "wheel speeds": WHEELS, "torque": DRIVES}
        lacks = [what for what, kinds in needed.items() if not kinds & self._kinds]
        if self._spans_ns and lacks:
            configured = {shown(sensor) for sensor in self._sensors.values()}
            drawn = "track only" if "accelerations" in lacks else "slope only"
            is_problem = any(needed[what] & configured for what in lacks)
            yield Hindrance(f"no {' and no '.join(lacks)}: {drawn}", is_problem)
        elif ground["fault"]:
            yield Hindrance(GROUND[ground["fault"]])
        calibration, spool = ground["calibration"], report["spool"]
        if self._is_sampled and spool["depth"] == spool["pending"] and not report["acknowledged"]:
            yield Hindrance("the first samples wait until their places are smoothed", is_problem=False)
        scale, scale_std = calibration["scale"], calibration["scale_std"]
        if Engine.kind in self._kinds and abs(scale) > max(REFERENCE_OFF, SURE * scale_std):
            looks = f"{100 * abs(scale):.0f} % too {'high' if scale > 0 else 'low'}"
            yield Hindrance(f"reference_torque_nm looks {looks}: compare it with the engine's plate, and `mass_kg`")
        if not lacks and calibration["calibrates"] and calibration["zero_std"] > CALIBRATED * ZERO_STD:
            yield Hindrance("calibrating: drive a closed loop, or reverse over your own track", is_problem=False)


def shown(sensor: SensorConfig) -> str:
    """The kind of a sensor; empty where it is not used for what that kind is needed for here."""
    return sensor.kind if sensor.kind not in NEEDED or sensor.provides(NEEDED[sensor.kind]) else ""


def _of_delivery(report: Mapping[str, Any]) -> Iterator[Hindrance]:
    """Why samples are lost, or wait for the map server."""
    for problem in filter(None, (report["spool_problem"], report["spool_damage"])):
        yield Hindrance(problem)
    spool, problem = report["spool"], report["uplink"]["problem"]
    if dropped := spool["dropped"] + spool["given_up"]:
        yield Hindrance(f"{dropped} samples were dropped: the spool is full; mend the link, or raise max_samples")
    if problem:
        held = spool["depth"] + spool["unsaved"]
        yield Hindrance(f"samples wait for the map server ({held} held): {problem}" if held else problem)


def _of_sensors(report: Mapping[str, Any]) -> Iterator[Hindrance]:
    """What is wrong with receivers, wheels, clocks, corrections and the calibration file."""
    for problem in report["driver_problems"]:
        yield Hindrance(problem)
    for name, fault in report["pipeline"]["faults"].items():
        yield Hindrance(f"{name} {fault}")
    if problem := (report.get("lanes") or {}).get("problem"):
        yield Hindrance(problem, is_problem=False)
    beside = ((report[name] or {}).get("problem") for name in ("corrections", "record"))
    for problem in filter(None, (report["clocks"], *beside, report["calibration_problem"])):
        yield Hindrance(problem)


def described(hindrances: Sequence[Hindrance]) -> dict[str, Any]:
    """As health has it. status: one sentence, of the worst. problems: all that has to be mended, the worst first."""
    problems = [hindrance.sentence for hindrance in hindrances if hindrance.is_problem]
    return {"status": hindrances[0].sentence if hindrances else DRAWS, "problems": problems}
