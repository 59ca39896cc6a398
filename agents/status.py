"""What hinders an agent, worst first, in sentences for terminal, log, health, doctor and page.

A problem needs a person; other hindrances pass, or are the machine's equipment.
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

WAIT_NS = 30 * 10**9  # in reading time; a driving machine has a heading after 10 to 20 s
SILENT_S = 10.0  # silence of sensors, which send each second
CALIBRATED = 0.5  # share of the accelerometer's initial deviation: some metres both ways, or a loop
REFERENCE_OFF, SURE = 0.05, 3.0  # torque scale beyond which the data sheet is wrong; standard deviations
UNIT = 1.5  # wheel over fix travel (or inverse) beyond any tyre: another unit
WHEELS = frozenset({Encoder.kind, Odometry.kind})
SPEEDS = WHEELS | {GpsVelocity.kind}
NEEDED = {Imu.kind: "force", Odometry.kind: "speed"}
DRAWS = "rolling resistance and slope go to the map"
GROUND = {  # sensor faults by the ground estimator's reason
    "no_imu": "no accelerations: track only",
    "no_wheels": "no wheel speeds: slope only",
    "no_torque": "no torque: slope only",
    "torque_frozen": "torque repeats one value: slope only; look at its sensor",
    "torque_implausible": "torque does not fit the motion: slope only; look at its unit and sign",
    "accelerometer": "accelerations are none of a machine on the ground: track only; look at unit and mount",
}


class Hindrance(NamedTuple):
    """Why samples are missing, waiting or incomplete."""

    sentence: str
    is_problem: bool = True


class Status:
    """Follows readings and judges a report. unsampled: why there is no sample, once certain."""

    def __init__(self, machine: MachineConfig) -> None:
        self.unsampled = ""
        self._sensors = {sensor.name: sensor for sensor in machine.sensors if sensor.use}
        self._kinds: set[str] = set()  # of the machine's own sensors
        self._spans_ns: dict[str, tuple[int, int]] = {}  # time span of each sensor's readings since a gap, by its clock
        self._is_sampled = False

    @property
    def heard(self) -> list[str]:
        """Sensors that had a reading."""
        return sorted(self._spans_ns.keys() & self._sensors.keys())

    def take(self, readings: Sequence[Reading]) -> None:
        """Add readings; time counts from the last gap, where localisation restarts."""
        for reading in readings:
            if (sensor := self._sensors.get(reading.sensor)) and sensor.kind == reading.kind:
                self._kinds.add(shown(sensor))
            first_ns, newest_ns = self._spans_ns.get(reading.sensor, (reading.stamp_ns, reading.stamp_ns))
            is_on = abs(reading.stamp_ns - newest_ns) <= GAP_NS
            self._spans_ns[reading.sensor] = (first_ns if is_on else reading.stamp_ns), reading.stamp_ns

    def sampled(self) -> None:
        """Note a sample, pending or final."""
        self._is_sampled, self.unsampled = True, ""

    def judge(self, report: Mapping[str, Any]) -> list[Hindrance]:
        """All current hindrances, worst first; report: the agent's, in plain values."""
        hindrances = [*self._of_places(report), *_of_delivery(report), *_of_sensors(report), *self._of_ground(report)]
        return list(dict.fromkeys(hindrances))

    def _of_places(self, report: Mapping[str, Any]) -> Iterator[Hindrance]:
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
        is_blind = not WHEELS & self._kinds and Imu.kind in self._kinds
        distance_m = UNSIGNED_M if is_blind else DISTANCE_M
        lacks = "" if SPEEDS & self._kinds else "no wheel speeds and no Doppler velocity: "
        return f"{lacks}the heading is unknown until the machine has driven {distance_m:g} m with GPS fixes"

    def _of_ground(self, report: Mapping[str, Any]) -> Iterator[Hindrance]:
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
    """A sensor's kind; empty if not used for that kind's purpose here."""
    return sensor.kind if sensor.kind not in NEEDED or sensor.provides(NEEDED[sensor.kind]) else ""


def _of_delivery(report: Mapping[str, Any]) -> Iterator[Hindrance]:
    for problem in filter(None, (report["spool_problem"], report["spool_damage"])):
        yield Hindrance(problem)
    spool, problem = report["spool"], report["uplink"]["problem"]
    if dropped := spool["dropped"] + spool["given_up"]:
        yield Hindrance(f"{dropped} samples were dropped: the spool is full; mend the link, or raise max_samples")
    if problem:
        held = spool["depth"] + spool["unsaved"]
        yield Hindrance(f"samples wait for the map server ({held} held): {problem}" if held else problem)


def _of_sensors(report: Mapping[str, Any]) -> Iterator[Hindrance]:
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
    """Health entries. status: the worst in one sentence. problems: all for a person, worst first."""
    problems = [hindrance.sentence for hindrance in hindrances if hindrance.is_problem]
    return {"status": hindrances[0].sentence if hindrances else DRAWS, "problems": problems}
