"""Positioning: dead reckoning and localisation, the half of the pure core that locates the machine."""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from operator import attrgetter
from typing import NamedTuple

from agents.dead_reckoning import DeadReckoning
from agents.estimation.ground import EstimationConfig
from agents.localisation.antennas import Antennas
from agents.localisation.filters.belief import DivergedError, PoseBelief
from agents.localisation.filters.smoother import SmoothedPose
from agents.localisation.imu_steps import Sensed
from agents.localisation.lanes.aid import LaneAid
from agents.localisation.localiser import HeadingRefutedError, LocalisationConfig, Localiser
from agents.localisation.tuning import TUNING, LocalisationTuning
from agents.localisation.wheels.judge import WheelJudge
from agents.sampling import PoseHistory
from agents.stream_order import Decision, StreamOrder, by_stamp
from protocol.arrays import Floats
from protocol.machine.machine_config import ABSOLUTE, MachineConfig
from protocol.machine.readings import Gps, Reading
from protocol.site.site_config import Projection, SiteConfig


@dataclass(frozen=True)
class PipelineConfig:
    """Options of the pure core, a table per stage."""

    localisation: LocalisationConfig = field(default_factory=LocalisationConfig)
    estimation: EstimationConfig = field(default_factory=EstimationConfig)


class Accepted(NamedTuple):
    """Readings of one stamp that count, at their measured stamp; a tuple, as hundreds come per second.

    poses: new or changed, oldest first. smoothed: newly final past poses, oldest first. restarts: nothing earlier
    counts; then smoothed holds all that remained, off_m the possible error of earlier places, concluded the poses that
    may become samples now.
    """

    readings: list[Sensed]
    poses: list[PoseBelief]
    smoothed: list[SmoothedPose]
    restarts: bool
    off_m: float = 0.0
    concluded: Sequence[PoseBelief] = ()


class Positioning:
    """Dead reckoning, localisation and pose history of one machine. lanes: of the shared map, or None."""

    def __init__(
        self, site: SiteConfig, machine: MachineConfig, config: PipelineConfig, tuning: LocalisationTuning = TUNING
    ) -> None:
        self._machine, self._config, self._tuning = in_name_order(machine), config.localisation, tuning
        self._mass = config.estimation.mass
        self._projection, self._extent_m = Projection(site), site.extent_m
        self._sensors = {s.name: s for s in machine.sensors if s.use}
        self._order = StreamOrder()
        self._counters: Counter[str] = Counter()
        is_default = config.localisation.profile == "default"  # the paper's method judges no wheels
        self.judge = WheelJudge(self._machine, self._projection) if is_default else None
        self._antennas = Antennas(self._machine, self._projection)
        self.lanes = LaneAid(machine.load_centre_m) if config.localisation.uses_lanes else None
        self._start()

    @property
    def pose(self) -> PoseBelief | None:
        """The newest pose, None until the heading is known."""
        return self.poses.newest

    def pose_at(self, stamp_ns: int) -> PoseBelief | None:
        """Pose at a recent stamp, or None."""
        return self.poses.at(stamp_ns)

    def slow_error_m(self, receiver: str) -> Floats:
        """Estimated slow error of a receiver (2,), east and north [m]."""
        return self.localiser.slow_error_m(receiver)

    @property
    def counters(self) -> Counter[str]:
        """Used and refused, including before restarts."""
        of_lanes = self.lanes.counters if self.lanes else Counter[str]()
        return self._counters + self._order.counters + self.localiser.counters + of_lanes

    @property
    def faults(self) -> dict[str, str]:
        """Faults of excluded or contradicting sensors, a sentence by sensor."""
        of_wheels = self.judge.problems if self.judge else {}
        return of_wheels | self._antennas.problems | self.localiser.watch.problem

    @property
    def clocks_s(self) -> dict[str, float]:
        """Lead over the accepted sensors [s], if some are refused for it; else empty."""
        return self._order.clocks_s

    def step(self, readings: Sequence[Reading]) -> list[SmoothedPose]:
        """Process readings in stamp order; returns newly final smoothed poses."""
        smoothed: list[SmoothedPose] = []
        for reading in readings:
            for accepted in self.accept(reading):
                smoothed += accepted.smoothed
                for pose in accepted.poses:
                    self.poses.append(pose)
        return smoothed

    def remaining(self) -> list[SmoothedPose]:
        """Smoothed poses not final, the last word at the end of the stream."""
        return self.localiser.remaining()

    def conclude(self) -> list[PoseBelief]:
        """Poses of a heading proven by what is known, at an end or pause of the stream."""
        return self.localiser.conclude(self.dead_reckoning.distance_m)

    def accept(self, reading: Reading) -> Iterable[Accepted]:
        """Add one reading; returns what counts of the stamp it completes, to be iterated at once.

        The caller appends each one's poses to `poses` before taking the next.
        """
        sensor = self._sensors.get(reading.sensor)
        if sensor is None or sensor.kind != reading.kind:
            self._counters["reading_unknown_sensor"] += 1
            return ()
        if isinstance(reading, Gps) and sensor.mode == ABSOLUTE and not self._is_on_site(reading):
            self._counters["fix_outside_site"] += 1
            return ()
        true_ns = sensor.true_ns(reading.stamp_ns) if sensor.delay_s else reading.stamp_ns
        ended = self._order.gather(reading, max(reading.stamp_ns, true_ns))  # never before it was measured
        return self._accept(ended) if ended else ()

    def finish(self) -> Iterable[Accepted]:
        """Process the last stamp at the end of the stream, like `accept`."""
        return self._accept(self._order.rest())

    def _accept(self, readings: Sequence[Reading]) -> Iterator[Accepted]:
        for group in by_stamp(map(self._undelayed, readings)):
            if accepted := self._take(group):
                yield accepted

    def _is_on_site(self, fix: Gps) -> bool:
        """Whether a fix is plausible: receivers without one state places on the equator; sites are mistaken."""
        x_m, y_m, _ = self._projection.to_map(fix.lat_deg, fix.lon_deg, fix.height_m)
        return max(abs(x_m), abs(y_m)) <= self._extent_m

    def _undelayed(self, reading: Reading) -> Reading:
        sensor = self._sensors[reading.sensor]
        return replace(reading, stamp_ns=sensor.true_ns(reading.stamp_ns)) if sensor.delay_s else reading

    def _take(self, readings: Sequence[Reading]) -> Accepted | None:
        taken: list[Sensed] = []
        smoothed: list[SmoothedPose] = []
        concluded: list[PoseBelief] = []
        restarts, off_m = False, 0.0
        for reading in readings:
            if (decision := self._order.decide(reading)) is Decision.REFUSE:
                continue
            if decision is Decision.RESTART:
                concluded += self.conclude()
                smoothed += self._restart(forgets_times=True)
                taken, restarts = [], True
            taken.append((reading, self._sensors[reading.sensor]))
        if not taken:
            return None
        heard = self.judge.heard(taken, self.dead_reckoning, self.localiser.variance_factor) if self.judge else taken
        if self.judge and (fall := self.judge.fall):
            self.judge.fall = None
            if self.localiser.is_proven and fall.is_headed:
                self.dead_reckoning.face(self.localiser.doubt(fall.off_m, fall.off_mps))
            else:
                concluded += self.conclude()
                smoothed += self._restart()
                restarts, off_m = True, fall.off_m
        if not heard and not restarts:
            return None
        for reading, sensor in heard:
            self.dead_reckoning.update(reading, sensor)
            self._antennas.take(reading, sensor, self.dead_reckoning)
        try:
            poses = self.localiser.update(heard, self.dead_reckoning) if heard else []
        except (DivergedError, HeadingRefutedError) as error:
            self._counters["heading_refuted" if isinstance(error, HeadingRefutedError) else "filter_restarts"] += 1
            off_m = getattr(error, "off_m", 0.0)
            concluded += self.conclude()
            smoothed += self._restart()
            poses, restarts = [], True
        return Accepted(heard or taken, poses, smoothed + self.localiser.take_smoothed(), restarts, off_m, concluded)

    def _restart(self, *, forgets_times: bool = False) -> list[SmoothedPose]:
        """Restart, keep counters; returns remaining smoothed poses. forgets_times: earlier stamps mean nothing now."""
        if self.judge and forgets_times:
            self.judge.forget_times()
        if self.localiser.is_aligned:  # a configured start is long past
            self._config = replace(self._config, start=())
        self._counters.update(self.localiser.counters)
        smoothed = self.localiser.take_smoothed() + self.remaining()
        self._start()
        return smoothed

    def _start(self) -> None:
        """Start with nothing known, as after power-up or a clock jump."""
        weighs = self._mass == "message"
        self.dead_reckoning = DeadReckoning(self._machine, self._config.slip, weighs=weighs)
        if self.lanes:
            self.lanes.restart()
        self.localiser = Localiser(
            self._machine,
            self._projection,
            self._config,
            is_weighed=self._is_weighed(),
            lanes=self.lanes,
            tuning=self._tuning,
        )
        self.poses = PoseHistory()
        self._antennas.restart()
        if self.judge:
            self.judge.restart()

    def _is_weighed(self) -> bool:
        """Whether the load is known; a machine without payload data carries none."""
        carries = self._machine.payload_x_m or self._machine.payload_z_m
        return not carries or self._mass != "message" or any(s.kind == "payload" for s in self._sensors.values())


def in_name_order(machine: MachineConfig) -> MachineConfig:
    """The machine with sensors by name: their order in a file must not change results."""
    return replace(machine, sensors=tuple(sorted(machine.sensors, key=attrgetter("name"))))
