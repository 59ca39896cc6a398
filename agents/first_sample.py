"""Why a machine has no sample yet: one sentence, once it has had readings for a while."""

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

from agents.localisation.alignment import DISTANCE_M
from agents.localisation.localiser import PROVEN_S
from agents.sampling import MAX_STD_M
from protocol.machine.clock_watch import GAP_NS
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Encoder, Gps, Odometry, Reading, Torque

WAIT_NS = 30 * 10**9  # in the readings' time; a machine that drives off has its heading after 10 to 20 s
UNIT = 1.5  # no tyre is so far off: wheels that turn so much further or less far than the fixes go have another unit
WHEELS = frozenset({Encoder.kind, Odometry.kind})
FOR_RESISTANCE = {"no wheel readings (encoder or odometry)": WHEELS, "no torque readings": frozenset({Torque.kind})}


class FirstSample:
    """Follows the readings of a machine until it has a sample. why_not: empty while nothing is known to be missing."""

    def __init__(self, machine: MachineConfig) -> None:
        self.why_not = ""
        self._sensors = {sensor.name: sensor.kind for sensor in machine.sensors if sensor.use}
        self._kinds: set[str] = set()
        self._spans_ns: dict[str, tuple[int, int]] = {}  # of each sensor's readings, by its own clock, since a gap
        self._is_sampled = self._is_judged = self._knew_clocks = False

    def take(self, readings: Sequence[Reading]) -> None:
        """Take in readings. The time counts from the first one behind a gap, as localisation starts anew there."""
        if self._is_judged or not readings:
            return
        self._kinds.update(r.kind for r in readings if self._sensors.get(r.sensor) == r.kind)
        for reading in readings:
            first_ns, newest_ns = self._spans_ns.get(reading.sensor, (reading.stamp_ns, reading.stamp_ns))
            is_on = abs(reading.stamp_ns - newest_ns) <= GAP_NS
            self._spans_ns[reading.sensor] = (first_ns if is_on else reading.stamp_ns), reading.stamp_ns

    def sampled(self) -> None:
        """Note that there is a sample, pending or final."""
        self._is_sampled, self.why_not = True, ""

    def judge(self, health: Callable[[], Mapping[str, Any]], clocks: str = "") -> str:
        """What is missing, in one sentence, once: WAIT_NS after the first reading. health, clocks: of the pipeline.

        Where samples wait for the proof of the heading, that has PROVEN_S more. Clocks that are apart may show later.
        """
        waited_ns = max((newest_ns - first_ns for first_ns, newest_ns in self._spans_ns.values()), default=0)
        if waited_ns < WAIT_NS or (self._is_judged and not self.why_not):
            return ""
        if self._is_judged and (self._knew_clocks or not clocks):
            return ""
        self._knew_clocks, state = bool(clocks), health()
        waits_for_proof = not self._is_sampled and state["aligned"] and not state["heading_proven"]
        if waits_for_proof and waited_ns < WAIT_NS + PROVEN_S * 1e9:
            return ""
        self._is_judged = True
        lacks = [what for what, kinds in FOR_RESISTANCE.items() if not kinds & self._kinds]
        if self._is_sampled:
            return f"samples have no rolling resistance: {', '.join(lacks)}" if lacks else ""
        causes = ([clocks] if clocks else missing(self._kinds, state)) + lacks
        self.why_not = f"no sample after {waited_ns // 10**9} s of readings: {', '.join(causes)}"
        return self.why_not


def missing(kinds: Collection[str], health: Mapping[str, Any]) -> list[str]:
    """Why no sample can be made. kinds: of the readings of the machine's own sensors. health: of the pipeline."""
    if not kinds:
        return ["none of them is of a sensor in the config"]
    if health["heading_proven"]:
        unsure = health["withheld"].get("unsure_position")
        return [f"the position is less certain than {MAX_STD_M:g} m" if unsure else "the machine has not moved"]
    causes = []
    if Gps.kind not in kinds:
        causes.append("no GPS fixes")
    elif health["counters"].get("fix_outside_site"):
        causes.append("GPS fixes outside the site")
    elif health["repeating"]:
        causes.append(f"{', '.join(health['repeating'])} repeats one fix")
    if not causes and health["aligned"]:
        turned = 1 + health["wheel_scale"]
        if WHEELS & set(kinds) and not 1 / UNIT < turned < UNIT:
            return [f"the wheels turn {turned:.1f} times as far as the fixes go: look at their unit"]
        return [f"the heading is not proven until fixes agree with it for {PROVEN_S:g} s and {DISTANCE_M:g} m"]
    return causes or [f"the heading is unknown until the machine has driven {DISTANCE_M:g} m with GPS fixes"]
