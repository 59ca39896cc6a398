"""The localiser: readings to poses. It collects until the heading shows, then tests it until it is proven.

A receiver that has just started is tens of metres off, so a heading by GPS is unproven at first, and all events are
kept. If the filter refuses a receiver until it relocks, the heading is withdrawn: what preceded the refusals is
dropped, the rest aligned and filtered again.
"""

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

from agents.dead_reckoning import DeadReckoning
from agents.localisation.alignment import DISTANCE_M, Alignment, align_fixes, align_start
from agents.localisation.consistency import Consistency
from agents.localisation.filters.belief import Belief, Filter, Measurement, PoseBelief, pose_of
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.smoother import SmoothedPose
from agents.localisation.filters.state import YAW
from agents.localisation.filters.ukf import Ukf
from agents.localisation.fix import Fix
from agents.localisation.imu_steps import FilterStep, Sensed, StepGatherer
from agents.localisation.lanes.aid import LaneAid
from agents.localisation.place_watch import PlaceWatch
from agents.localisation.repeats import Repeats
from agents.localisation.tracker import Event, Tracker, TrackerConfig, gps_velocity
from agents.localisation.tuning import TUNING, LocalisationTuning
from agents.localisation.wheels.travel_sign import TravelSign
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, GpsVelocity
from protocol.rotations import wrap_angle
from protocol.site.site_config import Projection

STEP_S = 0.05  # time step of the filter; cost grows with its inverse
COLLECTED = 24_000  # events kept while the heading is unproven: 20 minutes
PROVEN_S = 30.0  # time without refusals, and a further DISTANCE_M, to prove a heading
UNSIGNED_M = 60.0  # distance after which a first motion over ground counts as ahead
REFUTED_SIGMA = 3.0  # deviations by which refused fixes refute a proven heading
FILTERS: dict[str, Filter] = {"ekf": Ekf(), "ukf": Ukf()}
PROFILES = ("default", "paper")
MAP_AIDS = ("auto", "off")
MAX_LAG_S = 3600.0  # each second is a node to smooth


@dataclass(frozen=True)
class LocalisationConfig:
    """How positions are found.

    filter: ekf or ukf. profile: "paper" takes GPS errors as white, with filterpy's filters (extra `paper`); "default"
    estimates a slow error per receiver, a bias per yaw gyro and the wheel scale. start: known x, y [m] and heading
    [rad] in `map`, instead of alignment and GPS; it counts once, not after a pause or clock jump. slip, slip_soft: of
    the tyres, per traction on firm ground, and its rise with rolling resistance. lag_s: of the smoother, 0 for none, as
    in "paper". map_aid: "auto" uses lanes of the shared map, except in "paper"; "off" never.
    """

    filter: str = "ukf"
    profile: str = "default"
    start: tuple[float, ...] = ()
    slip: float = 0.1
    slip_soft: float = 0.9
    lag_s: float = 90.0
    map_aid: str = "auto"

    def __post_init__(self) -> None:
        if self.filter not in FILTERS:
            raise ValueError(f"filter: {self.filter!r} is neither {' nor '.join(FILTERS)}")
        if self.profile not in PROFILES:
            raise ValueError(f"profile: {self.profile!r} is neither {' nor '.join(PROFILES)}")
        if self.map_aid not in MAP_AIDS:
            raise ValueError(f"map_aid: {self.map_aid!r} is neither {' nor '.join(MAP_AIDS)}")
        if not (0 <= self.slip < 1 and 0 <= self.slip_soft < math.inf):
            raise ValueError("slip: must be from 0 to below 1, slip_soft not negative")
        if not 0 <= self.lag_s <= MAX_LAG_S:
            raise ValueError(f"lag_s: must be from 0 to {MAX_LAG_S:.0f} s")
        if len(self.start) not in (0, 3) or not all(map(math.isfinite, self.start)):
            raise ValueError("start: must be x, y and heading, or empty")

    @property
    def smoothing_s(self) -> float:
        """Lag of the smoother; 0 in profile `paper`."""
        return self.lag_s if self.profile == "default" else 0.0

    @property
    def uses_lanes(self) -> bool:
        """Whether lanes of the shared map are used."""
        return self.map_aid == "auto" and self.profile == "default"


class HeadingRefutedError(ArithmeticError):
    """A proven heading is wrong. off_m: position error when that showed."""

    def __init__(self, off_m: float) -> None:
        super().__init__(f"the heading is wrong, the place by {off_m:.0f} m")
        self.off_m = off_m


class Localiser:
    """Fuses GPS, IMUs and wheels into 15 states and slow sensor errors.

    engine: the filter; experiments may replace it before the first reading. is_weighed: the load is known. is_proven:
    poses may become samples. watch: for position jumps.
    """

    def __init__(
        self,
        machine: MachineConfig,
        projection: Projection,
        config: LocalisationConfig,
        step_s: float = STEP_S,
        *,
        is_weighed: bool = True,
        lanes: LaneAid | None = None,
        tuning: LocalisationTuning = TUNING,
    ) -> None:
        """Start; `lanes` are those of the shared map."""
        self.engine = _engine(config)
        self.is_proven = False
        self.watch = PlaceWatch()
        self._config = config
        tyres, is_started = (config.slip, config.slip_soft), bool(config.start)
        self._tracker_config = TrackerConfig(
            machine, projection, config.profile, tyres, step_s, config.smoothing_s, is_started, is_weighed, tuning
        )
        self._tracker, self._lanes = Tracker(self._tracker_config), lanes
        self._gatherer = StepGatherer(machine, step_s)
        self._repeats = Repeats()
        self._accelerometers = [s.name for s in machine.sensors if s.kind == "imu" and s.use and s.provides("force")]
        self._sign = TravelSign() if self._accelerometers and not config.start else None  # None: known or not shown
        self._stepped_ns = 0
        self._counters: Counter[str] = Counter()
        self._steps: deque[FilterStep] = deque(maxlen=COLLECTED)
        self._fixes: deque[Fix] = deque(maxlen=COLLECTED)
        self._velocities: deque[Measurement] = deque(maxlen=COLLECTED)
        self._refused: deque[Fix] = deque(maxlen=COLLECTED)  # since the last accepted one
        self._since: tuple[int, float] = (0, 0.0)  # stamp of the first fix that counts, distance at the alignment
        self._aligned_scale = 0.0  # of the wheels, by the newest alignment
        self._poses: deque[PoseBelief] = deque(maxlen=COLLECTED)  # of the unproven heading
        self._smoothed: list[SmoothedPose] = []

    @property
    def is_aligned(self) -> bool:
        """Whether the heading is known."""
        return self._tracker.fusion is not None

    @property
    def counters(self) -> Counter[str]:
        """Measurements used and gated, readings refused."""
        of_parts = [part.counters for part in (self._tracker, self._gatherer, self._repeats, self.watch)]
        return sum(of_parts, self._counters)

    @property
    def repeating(self) -> list[str]:
        """Receivers that keep repeating one value while the machine moves."""
        return self._repeats.lasting

    @property
    def consistency(self) -> dict[str, Consistency]:
        """Filter consistency with each GPS receiver that has enough fixes."""
        return self._tracker.receivers.consistency

    def variance_factor(self, receiver: str) -> float:
        """Factor applied to a receiver's stated variance [-]."""
        return self._tracker.receivers.variance_factor(receiver)

    def slow_error_m(self, receiver: str) -> Floats:
        """Estimated slow error of a receiver (2,), east and north [m]; zeros if it is no state."""
        return self._tracker.slow_error_m(receiver)

    @property
    def machine_share(self) -> float | None:
        """Assumed share of slow variance common to the receivers; None with fewer than two."""
        return self._tracker.receivers.machine_share

    @property
    def wheel_scale(self) -> float | None:
        """Wheel travel over machine travel, less 1; of the alignment while the heading is unproven; None: no state."""
        return self._aligned_scale if self.is_aligned and not self.is_proven else self._tracker.wheel_scale

    @property
    def belief(self) -> Belief | None:
        """The whole state, once known."""
        return self._tracker.belief

    def take_smoothed(self) -> list[SmoothedPose]:
        """Newly final smoothed poses, oldest first; none of an unproven heading."""
        if self._tracker.fusion:
            self._smoothed += self._aided(self._tracker.fusion.take_smoothed())
        if not self.is_proven:
            return []
        taken, self._smoothed = self._smoothed, []
        return taken

    def remaining(self) -> list[SmoothedPose]:
        """Smoothed poses not yet final, the newest belief's last; they stay."""
        fusion = self._tracker.fusion
        return self._smoothed + self._aided(fusion.remaining()) if fusion else []

    def _aided(self, poses: list[SmoothedPose]) -> list[SmoothedPose]:
        return [replace(pose, aid_share=self._tracker.aid_share(pose.cross)) for pose in poses]

    def doubt(self, off_m: float, off_mps: float) -> float:
        """Widen position and speed after bad wheels misled both; returns the heading."""
        return self._tracker.doubt(off_m, off_mps)

    def update(self, readings: Sequence[Sensed], dead_reckoning: DeadReckoning) -> list[PoseBelief]:
        """Add the readings of one stamp, after dead reckoning; returns new or changed poses in stamp order.

        Poses of an unproven heading come again once proven. HeadingRefutedError: only a new start helps.
        """
        distance_m, was_proven = dead_reckoning.distance_m, self.is_proven
        beliefs: list[Belief] = []
        for event in self._events(readings, dead_reckoning):
            if isinstance(event, FilterStep) and event.silent and self._sign:
                self._judge_sign(self._sign, event, dead_reckoning)
            beliefs += self._filter(event, distance_m) if self.is_aligned else self._collect(event, distance_m)
        if was_proven and not beliefs:  # the usual case
            return []
        wheels_mps = None if dead_reckoning.is_silent(readings[0][0].stamp_ns) else dead_reckoning.wheels.speed_mps
        poses = [pose_of(belief, wheels_mps, self._tracker.aid_share(belief.P)) for belief in beliefs]
        if was_proven:
            return poses
        self._keep(poses)
        return self._proven_poses() if self.is_proven else poses

    def conclude(self, distance_m: float) -> list[PoseBelief]:
        """Prove the heading at the end of the data; returns the poses that may become samples."""
        if self.is_proven or not self._holds(distance_m):
            return []
        self.is_proven = True
        return self._proven_poses()

    def _judge_sign(self, sign: TravelSign, step: FilterStep, dead_reckoning: DeadReckoning) -> None:
        """Check the sign of speeds over ground, as the first motion may have been in reverse.

        If so, collected events are dropped; HeadingRefutedError if the heading was proven.
        """
        dt_s, self._stepped_ns = (step.stamp_ns - self._stepped_ns) * 1e-9, step.stamp_ns
        for mean in (step.imu_means[name] for name in self._accelerometers if name in step.imu_means):
            sign.add_force(float(mean.force_mps2[0]), -float(mean.rates_radps[1]), dt_s)
            break
        if dead_reckoning.ground:
            sign.add_speed(dead_reckoning.ground.middle_ns, dead_reckoning.ground.speed_mps)
        if not (shown := sign.sign):
            return
        self._sign = None
        if shown < 0:
            self._counters["first_motion_reversed"] += 1
            if self.is_proven:
                raise HeadingRefutedError(0.0)
            dead_reckoning.turn_round()
            self._tracker = Tracker(self._tracker_config)
            self._smoothed.clear()
            for kept in (self._steps, self._fixes, self._velocities, self._refused, self._poses):
                kept.clear()

    def _events(self, readings: Sequence[Sensed], dead_reckoning: DeadReckoning) -> list[Event]:
        events: list[Event] = []
        for reading, sensor in readings:
            if isinstance(reading, Gps):
                if not self._repeats.is_repeated(reading, dead_reckoning.distance_m):
                    events.append(self._tracker.receivers.fix(reading, dead_reckoning.pose))
            elif isinstance(reading, GpsVelocity):
                events.append(gps_velocity(reading, sensor, self._tracker_config.tuning))
        step = self._gatherer.gather(readings, dead_reckoning)
        return [step, *events] if step else events

    def _filter(self, event: Event, distance_m: float) -> list[Belief]:
        """Beliefs that an event changed; a fix may prove or withdraw the heading."""
        if not self.is_proven:
            self._remember(event)
        self._tracker.lanes = self._lanes if self.is_proven else None
        beliefs = self._tracker.filter(event)
        if isinstance(event, Fix) and event.is_absolute and self._config.profile == "default":
            if shown := self._contradiction(event):
                return self._take_back(shown, distance_m)
            self.is_proven = self.is_proven or (self._is_old(event) and self._holds(distance_m))
        return beliefs

    def _contradiction(self, fix: Fix) -> Alignment | None:
        """The alignment by refused fixes, once too many; HeadingRefutedError if it refutes a proven heading."""
        if self._tracker.is_accepted(fix):
            self._refused.clear()
            self.watch.look(fix.stamp_ns)
            return None
        self._refused.append(fix)
        if not self._tracker.has_relocked or self._tracker.receivers.is_outvoted(fix):
            return None
        shown = align_fixes(self._refused)
        if self.is_proven:
            since_ns = self._refused[0].stamp_ns
            self.watch.jumped(fix.sensor.name, since_ns, fix.stamp_ns, self._tracker.off_m(fix))
        if not self.is_proven or not shown:
            return shown
        belief = self._tracker.belief
        assert belief is not None
        believed_rad = float(belief.x[YAW]) - fix.reckoned.angle_rad
        std_rad = math.hypot(shown.std_rad, math.sqrt(belief.P[YAW, YAW]))
        if abs(wrap_angle(shown.rotation_rad - believed_rad)) > REFUTED_SIGMA * std_rad:
            raise HeadingRefutedError(math.hypot(*self._tracker.off_m(fix)))
        return None

    def _take_back(self, shown: Alignment, distance_m: float) -> list[Belief]:
        """Restart from the refusals, with the alignment they show.

        Steps before the refuted heading are dropped, else each restart would filter more than the last.
        """
        self._counters["heading_taken_back"] += 1
        self._tracker = Tracker(self._tracker_config)
        self._poses.clear()
        self._smoothed.clear()
        while self._steps[0].stamp_ns < self._since[0] and len(self._steps) > 1:
            self._steps.popleft()
        self._forget(self._refused[0].stamp_ns)
        self._refused.clear()
        return self._start(shown, distance_m)

    def _forget(self, before_ns: int) -> None:
        self._counters["fix_before_alignment"] += sum(fix.stamp_ns < before_ns for fix in self._fixes)
        for kept in (self._fixes, self._velocities):
            while kept and kept[0].stamp_ns < before_ns:
                kept.popleft()

    def _is_old(self, fix: Fix) -> bool:
        return fix.stamp_ns - self._since[0] >= PROVEN_S * 1e9

    def _holds(self, distance_m: float) -> bool:
        """Whether a wrong heading would have shown by now."""
        return self.is_aligned and distance_m - self._since[1] >= DISTANCE_M and not self._refused

    def _keep(self, poses: Sequence[PoseBelief]) -> None:
        """Keep poses of an unproven heading; later ones replace those not older."""
        for pose in poses:
            while self._poses and pose.stamp_ns <= self._poses[-1].stamp_ns:
                self._poses.pop()
            self._poses.append(pose)

    def _proven_poses(self) -> list[PoseBelief]:
        poses = list(self._poses)
        for kept in (self._poses, self._steps, self._fixes, self._velocities):
            kept.clear()
        return poses

    def _remember(self, event: Event) -> None:
        if isinstance(event, Fix):
            self._fixes.append(event)
        elif isinstance(event, Measurement):
            self._velocities.append(event)
        else:
            self._steps.append(event)

    def _collect(self, event: Event, distance_m: float) -> list[Belief]:
        is_blind = isinstance(event, FilterStep) and event.silent and not event.wheels.is_known
        if is_blind and not self._config.start:
            return []  # no start before it has moved
        self._remember(event)
        alignment: Alignment | None = None
        if isinstance(event, FilterStep):
            alignment = align_start(self._config.start, self._steps[0].reckoned) if self._config.start else None
        elif isinstance(event, Fix) and self._steps and distance_m >= self._least_m():
            alignment = align_fixes(self._fixes)
        return self._start(alignment, distance_m) if alignment else []

    def _least_m(self) -> float:
        return UNSIGNED_M if self._sign and self._steps[-1].silent else DISTANCE_M

    def _start(self, alignment: Alignment, distance_m: float) -> list[Belief]:
        """Filter everything kept. A configured start and profile `paper` need no proof."""
        self._forget(alignment.since_ns)
        self._aligned_scale = alignment.wheel_scale
        self._since = self._fixes[0].stamp_ns if self._fixes else 0, distance_m
        self.is_proven = bool(self._config.start) or self._config.profile != "default"
        beliefs = [self._tracker.start(self.engine, alignment, self._steps[0])]
        events: list[Event] = [*list(self._steps)[1:], *self._fixes, *self._velocities]
        for event in sorted(events, key=lambda e: e.stamp_ns):
            beliefs += self._tracker.filter(event)
        return beliefs


def _engine(config: LocalisationConfig) -> Filter:
    """The filter; filterpy is imported only for profile `paper`."""
    if config.profile != "paper":
        return FILTERS[config.filter]
    from agents.localisation.filters.textbook import TextbookEkf, TextbookUkf

    return TextbookEkf() if config.filter == "ekf" else TextbookUkf()
