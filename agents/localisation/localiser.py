"""The localiser: readings in, poses out. Until it knows its heading it only collects.

It is one module because every kind of event meets here the one filter that all of them change.
"""

import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from agents.dead_reckoning import DeadReckoning, turn_source
from agents.localisation.alignment import Alignment, align_fixes, align_start, start_belief
from agents.localisation.consistency import Consistency
from agents.localisation.corrections import Corrections, not_used
from agents.localisation.filters.belief import Belief, Filter, Measurement, PoseBelief, pose_of
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.late_measurements import Fusion
from agents.localisation.filters.motion import GpsError, MotionModel
from agents.localisation.filters.smoother import SmoothedPose, nothing_past
from agents.localisation.filters.state import YAW, Layout, X, Y, Z
from agents.localisation.filters.ukf import Ukf
from agents.localisation.gps import Fix, Receivers, drifting
from agents.localisation.gps_velocity import gps_velocity
from agents.localisation.headings import References, heading_references
from agents.localisation.imu_steps import FilterStep, Sensed, StepGatherer
from agents.localisation.measurements import STANDSTILL
from agents.localisation.motion_sensors import MotionSensors, shows_tilt
from agents.localisation.sensor_modes import ModalSensors, Value
from protocol.machine.machine_config import ABSOLUTE, MachineConfig
from protocol.machine.readings import Correction, Gps, GpsVelocity
from protocol.site.site_config import Projection

STEP_S = 0.05  # time step of the filter; its cost grows with the inverse
# Without GPS for so long, wheels and IMUs teach neither place and heading nor the wheels' scale s and the gyros' bias:
# they show none of them, but h = (1 + s) v and the centripetal w x v are linearised at a speed and a rate that jitter
# from step to step, which looks like information. Fixes outweigh it; without them it bent the scale by 6 % and the bias
# by 0.4 degrees per second in ten minutes. Standstills and absolute headings still teach all that correlates with them.
UNPLACED_S = 5.0
COLLECTED = 24_000  # steps and fixes kept while the heading is unknown: 20 minutes; a machine that waits needs no more
Event = FilterStep | Fix | Measurement  # what the filter takes; a measurement stands for itself
FILTERS: dict[str, Filter] = {"ekf": Ekf(), "ukf": Ukf()}
PROFILES = ("default", "paper")
MAX_LAG_S = 3600.0  # each second of it is a node to smooth


@dataclass(frozen=True)
class LocalisationConfig:
    """How positions are found.

    filter: ekf or ukf. profile: "paper" takes GPS errors as white, and runs filterpy's filters (extra `paper`);
    "default" estimates a slow error of each receiver, a bias of each yaw gyro and the wheels' scale, with our own.
    start: x, y [m] and heading [rad] in `map`, where they are known: no alignment is needed then, nor GPS. It counts
    once: after a pause or a jump of the clock the machine may be anywhere. slip, slip_soft: wheel slip per traction on
    firm ground, and how much it rises with the rolling resistance; of the tyres. lag_s: how long places of the past are
    smoothed by what comes after them, 0 for not at all; "paper" never smooths.
    """

    filter: str = "ukf"
    profile: str = "default"
    start: tuple[float, ...] = ()
    slip: float = 0.1
    slip_soft: float = 0.9
    lag_s: float = 90.0

    def __post_init__(self) -> None:
        if self.filter not in FILTERS:
            raise ValueError(f"filter: {self.filter!r} is neither {' nor '.join(FILTERS)}")
        if self.profile not in PROFILES:
            raise ValueError(f"profile: {self.profile!r} is neither {' nor '.join(PROFILES)}")
        if not (0 <= self.slip < 1 and 0 <= self.slip_soft < math.inf):
            raise ValueError("slip: must be from 0 to below 1, slip_soft not negative")
        if not 0 <= self.lag_s <= MAX_LAG_S:
            raise ValueError(f"lag_s: must be from 0 to {MAX_LAG_S:.0f} s")
        if len(self.start) not in (0, 3) or not all(map(math.isfinite, self.start)):
            raise ValueError("start: must be x, y and heading, or empty")

    @property
    def smoothing_s(self) -> float:
        """The lag of the smoother; 0 for the profile `paper`, whose method has none."""
        return self.lag_s if self.profile == "default" else 0.0


class Localiser:
    """Fuses GPS, IMUs and wheels over 15 states and the sensors' slow errors; takes readings in nearly any order.

    engine: the filter; an evaluation may put one that watches it in its place, before the first reading.
    """

    def __init__(
        self, machine: MachineConfig, projection: Projection, config: LocalisationConfig, step_s: float = STEP_S
    ) -> None:
        self._config = config
        self.engine = _engine(config)
        augmented = config.profile == "default"
        layout = _layout_of(machine) if augmented else Layout()
        self._gatherer = StepGatherer(machine, step_s)
        self._receivers = Receivers(
            machine.sensors, projection, layout, slow=augmented, machine_share=machine.machine_share
        )
        self._base = machine.base
        self._corrections = Corrections(machine.base, layout) if machine.base and layout.base else None
        self._references = References(machine.sensors, layout, slow=augmented)
        source, on_plane = turn_source(machine), not shows_tilt(machine, config.profile)
        tyres = config.slip, config.slip_soft
        self._body = MotionSensors(machine, layout, step_s, tyres, on_plane=on_plane)
        turn_error = self._body.turn_error_radps if augmented and source and source.kind == "odometry" else 0.0
        self._model = MotionModel(layout, on_plane, self._gps_errors(), turn_error_radps=turn_error)
        self._fusion: Fusion | None = None
        self._placed_ns = 0  # stamp of the newest fix or velocity by GPS that was accepted
        self._steps: deque[FilterStep] = deque(maxlen=COLLECTED)
        self._fixes: deque[Fix] = deque(maxlen=COLLECTED)
        self._velocities: deque[Measurement] = deque(maxlen=COLLECTED)

    @property
    def is_aligned(self) -> bool:
        """Whether the heading is known."""
        return self._fusion is not None

    @property
    def counters(self) -> Counter[str]:
        """Measurements used and gated, readings refused."""
        of_parts = [part.counters for part in (self._fusion, self._corrections) if part]
        return sum(of_parts, self._body.counters + self._gatherer.counters)

    @property
    def consistency(self) -> dict[str, Consistency]:
        """How consistent the filter is with each GPS receiver, of those with enough fixes."""
        return self._receivers.consistency

    def base_report(self) -> dict[str, Any] | None:
        """Whether the corrections of a base station are used, and why not; None of a machine that uses none."""
        if self._corrections:
            return self._corrections.report(self._fusion.belief.stamp_ns if self._fusion else 0)
        return not_used(self._base, self._config.profile) if self._base else None

    @property
    def machine_share(self) -> float | None:
        """Share of the slow variance that the receivers have in common, as it is taken for; None of fewer than two."""
        return self._receivers.machine_share

    @property
    def wheel_scale(self) -> float | None:
        """How much further the wheels turn than the machine moves [-], as believed; None where it is no state."""
        states = self._model.layout.wheel_scales
        return float(self.belief.x[states.start]) if self.belief and states.stop > states.start else None

    @property
    def belief(self) -> Belief | None:
        """The whole state, once it is known."""
        return self._fusion.belief if self._fusion else None

    def take_smoothed(self) -> list[SmoothedPose]:
        """Smoothed poses that became final since the last call, oldest first."""
        return self._fusion.take_smoothed() if self._fusion else []

    def remaining(self) -> list[SmoothedPose]:
        """Smoothed poses within the lag, as known by now; the last is the newest belief's. They stay."""
        return self._fusion.remaining() if self._fusion else []

    def take(self, correction: Correction) -> None:
        """Keep a correction of a base station until it is due, with a later reading."""
        if self._corrections and self._fusion:
            self._corrections.take(correction, self._fusion.belief.stamp_ns)

    def update(self, readings: Sequence[Sensed], dead_reckoning: DeadReckoning) -> list[PoseBelief]:
        """Take in the readings of one stamp, after dead reckoning did; returns poses that became possible or changed.

        In the order of their stamps.
        """
        fast: list[Sensed] = []
        events: list[Event] = []
        for reading, sensor in readings:
            if isinstance(reading, Gps):
                events.append(self._receivers.fix(reading, dead_reckoning.pose))
            elif isinstance(reading, GpsVelocity):
                events.append(gps_velocity(reading, sensor))
            else:
                fast.append((reading, sensor))
        if fast and (step := self._gatherer.gather(fast, dead_reckoning)):
            events.insert(0, step)
        beliefs: list[Belief] = []
        for event in events:
            known = self._fusion
            beliefs += self._filter(known, event) if known else self._collect(event, dead_reckoning.distance_m)
        return [pose_of(belief, dead_reckoning.wheels.speed_mps) for belief in beliefs]

    def _filter(self, fusion: Fusion, event: Event) -> list[Belief]:
        """Beliefs that an event changed, and then a correction that is due."""
        beliefs = self._filter_own(fusion, event)
        return beliefs + self._correct(fusion, self._corrections, event) if self._corrections else beliefs

    def _filter_own(self, fusion: Fusion, event: Event) -> list[Belief]:
        """Beliefs that an event of the machine's own sensors changed."""
        if not isinstance(event, FilterStep):
            return self._place(fusion, event)
        absolute = self._references.measurements(event, fusion.belief)
        errors = self._references.errors
        layout = fusion.model.layout
        unplaced = layout.wheel_scale and event.stamp_ns - self._placed_ns > UNPLACED_S * 1e9
        reckons = unplaced and bool(self._placed_ns or self._config.start)  # else the fix that aligned it comes at once
        fusion.model = replace(fusion.model, traction=event.traction, heading_errors=errors, reckons=reckons)
        beliefs: list[Belief] = []
        for orientation in self._references.own_stamped(event):
            beliefs += self._filter_modal(fusion, self._references, orientation)
        inertial, turn, wheels = self._body.inertial(event), self._body.turn(event), self._body.wheels(event)
        if unplaced:
            headed = (YAW, *range(layout.gyro_biases.start, layout.gyro_biases.stop)) if reckons else ()
            considers = (X, Y, Z, layout.wheel_scales.start, *headed)
            inertial, wheels = ([_considering(m, considers) for m in several] for several in (inertial, wheels))
        measurements = [*inertial, *absolute, *turn, *wheels]
        return beliefs + (fusion.add(measurements) if measurements else [])

    def _place(self, fusion: Fusion, event: Fix | Measurement) -> list[Belief]:
        """Beliefs that a fix or a velocity by GPS changed."""
        if isinstance(event, Fix):
            name, beliefs = event.sensor.name, self._filter_modal(fusion, self._receivers, event)
        else:
            name, beliefs = event.sensor, fusion.add([event])
        if beliefs and fusion.last[name].accepted:
            self._placed_ns = max(self._placed_ns, event.stamp_ns)
        return beliefs

    def _correct(self, fusion: Fusion, corrections: Corrections, event: Event) -> list[Belief]:
        """Beliefs that a base station's corrections changed, as of what the event shows."""
        if isinstance(event, Fix):
            corrections.compare(event, fusion.belief, *self._receivers.expected(event))
        if not isinstance(event, FilterStep):
            return []
        corrections.follow(fusion.belief)
        if (measurement := corrections.measurement(fusion.belief)) is None:
            return []
        fusion.model = replace(fusion.model, gps_errors=self._gps_errors())
        beliefs = fusion.add([measurement])
        corrections.confirm(fusion.last[measurement.sensor])
        return beliefs

    def _gps_errors(self) -> tuple[GpsError, ...]:
        """Slow errors of the machine's receivers and, where it uses one, of the base station's."""
        base = self._corrections
        return self._receivers.errors_beside(base.base_error, base.site_share) if base else self._receivers.errors

    def _filter_modal(self, fusion: Fusion, sensors: ModalSensors[Value], value: Value) -> list[Belief]:
        """Filter a value whose sensor may count from what is believed at its stamp."""
        if sensors.needs_anchor(value):
            sensors.anchor(value, fusion.at(value.stamp_ns))
        measurement = sensors.measurement(value)
        if measurement is None:
            return []
        fusion.model = replace(fusion.model, gps_errors=self._gps_errors())
        beliefs = fusion.add([measurement])
        if beliefs:
            sensors.confirm(value, fusion.last[measurement.sensor])
        return beliefs

    def _collect(self, event: Event, distance_m: float) -> list[Belief]:
        """Keep an event until the heading is known, then filter all that was kept."""
        alignment: Alignment | None = None
        if isinstance(event, Fix):
            self._fixes.append(event)
            alignment = align_fixes(self._fixes, distance_m) if self._steps else None
        elif isinstance(event, Measurement):
            self._velocities.append(event)
        else:
            self._steps.append(event)
            alignment = align_start(self._config.start, self._steps[0].reckoned) if self._config.start else None
        return self._start(alignment) if alignment else []

    def _start(self, alignment: Alignment) -> list[Belief]:
        first, layout = self._steps[0], self._model.layout
        belief = start_belief(alignment, first, self._body.forces(first), layout, self._body.turn_error_radps)
        belief = replace(belief, past=nothing_past(layout.n, self._config.smoothing_s))
        self._fusion = Fusion(self.engine, self._model, belief)
        beliefs = [belief]
        events: list[Event] = [*list(self._steps)[1:], *self._fixes, *self._velocities]
        for event in sorted(events, key=lambda e: e.stamp_ns):
            beliefs += self._filter(self._fusion, event)
        self._steps.clear()
        self._fixes.clear()
        self._velocities.clear()
        return beliefs


def _considering(measurement: Measurement, states: tuple[int, ...]) -> Measurement:
    """The measurement, which leaves these states as they are; a standstill is no jitter, and teaches."""
    return measurement if measurement.sensor == STANDSTILL else replace(measurement, considers=states)


def _engine(config: LocalisationConfig) -> Filter:
    """Our own filter, or the textbook's, which is imported for the profile that needs it alone."""
    if config.profile != "paper":
        return FILTERS[config.filter]
    from agents.localisation.filters.textbook import TextbookEkf, TextbookUkf

    return TextbookEkf() if config.filter == "ekf" else TextbookUkf()


def _layout_of(machine: MachineConfig) -> Layout:
    """States for the slow errors of a machine's sensors."""
    source = turn_source(machine)
    imus = sum(s.kind == "imu" and s.use for s in machine.sensors)
    turns = imus + (source is not None and source.kind != "imu")
    receivers, references = drifting(machine.sensors), heading_references(machine.sensors)
    base = machine.base is not None and any(s.mode == ABSOLUTE for s in receivers)
    return Layout(turns, True, len(receivers) + base, len(references), base)
