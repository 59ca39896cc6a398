"""The tracker filters everything a machine senses, from one alignment on."""

from collections import Counter
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from agents.dead_reckoning import DeadReckonedPose, turn_source
from agents.ground_speed import velocity_variances
from agents.localisation import measurements
from agents.localisation.alignment import Alignment, start_belief
from agents.localisation.filters.belief import Belief, Change, Filter, Measurement, open_states, reset_states
from agents.localisation.filters.late_measurements import Fusion
from agents.localisation.filters.motion import MotionModel
from agents.localisation.filters.smoother import nothing_past
from agents.localisation.filters.state import SPEED, YAW, Layout, X, Y, Z
from agents.localisation.fix import Fix
from agents.localisation.gps import Receivers, drifting
from agents.localisation.headings import References, heading_references
from agents.localisation.imu_steps import FilterStep
from agents.localisation.lanes.aid import LaneAid
from agents.localisation.measurements import PLACE
from agents.localisation.motion_sensors import MotionSensors, shows_tilt
from agents.localisation.sensor_modes import ModalSensors, Value
from agents.localisation.tuning import TUNING, LocalisationTuning
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import GpsVelocity
from protocol.site.site_config import Projection

Event = FilterStep | Fix | Measurement  # inputs of the filter


@dataclass(frozen=True)
class TrackerConfig:
    """Parts of a tracker.

    profile: of localisation. tyres: `slip`, `slip_soft`. is_started: the start is configured, so a machine without GPS
    reckons from it. is_weighed: its load is known.
    """

    machine: MachineConfig
    projection: Projection
    profile: str
    tyres: tuple[float, float]
    step_s: float
    smoothing_s: float
    is_started: bool
    is_weighed: bool
    tuning: LocalisationTuning = TUNING

    @property
    def slow(self) -> bool:
        """Whether slow sensor errors are states."""
        return self.profile == "default"


class Tracker:
    """Filters events into beliefs. fusion: None until `start`.

    has_relocked: whether the newest fix relocked its receiver. lanes: of the shared map, or None.
    """

    def __init__(self, config: TrackerConfig) -> None:
        machine, slow, tuning = config.machine, config.slow, config.tuning
        layout = layout_of(machine) if slow else Layout()
        share, projection = machine.machine_share, config.projection
        self.fusion: Fusion | None = None
        self.has_relocked = False
        self.lanes: LaneAid | None = None
        self.receivers = Receivers(machine.sensors, projection, layout, tuning, slow=slow, machine_share=share)
        self._config = config
        self._references = References(machine.sensors, layout, tuning, slow=slow)
        source, on_plane = turn_source(machine), not shows_tilt(machine, config.profile)
        self._body = MotionSensors(
            machine,
            layout,
            config.step_s,
            config.tyres,
            on_plane=on_plane,
            is_weighed=config.is_weighed or not slow,
            tuning=tuning,
        )
        turn_error = self._body.turn_error_radps if slow and source and source.kind == "odometry" else 0.0
        unseen = slow and source is None
        self._model = MotionModel(
            layout, on_plane, self.receivers.errors, turn_error_radps=turn_error, turns_unseen=unseen, tuning=tuning
        )
        self._doubt: Change | None = None
        self._placed_ns = 0  # stamp of the newest accepted GPS fix or velocity

    @property
    def counters(self) -> Counter[str]:
        """Measurements used and gated, readings refused."""
        of_fusion = self.fusion.counters if self.fusion else Counter[str]()
        return self._body.counters + of_fusion

    @property
    def belief(self) -> Belief | None:
        """The whole state, once known."""
        return self.fusion.belief if self.fusion else None

    @property
    def wheel_scale(self) -> float | None:
        """Estimated wheel travel over machine travel, less 1; None if it is no state."""
        states = self._model.layout.wheel_scales
        return float(self.belief.x[states.start]) if self.belief and states.stop > states.start else None

    def slow_error_m(self, receiver: str) -> Floats:
        """Estimated slow error of a receiver (2,), east and north [m]; zeros if it is no state."""
        states = self.receivers.error_states(receiver)
        return self.belief.x[states] if self.belief and states else np.zeros(2)

    def aid_share(self, cross: Floats) -> float:
        """Share of a position that came from lanes, 0 to 1; cross (2 or more, n): its covariance with the state."""
        layout = self.fusion.model.layout if self.fusion else self._model.layout
        return self.lanes.share(cross[:2, layout.map_offset]) if layout.lanes and self.lanes else 0.0

    def doubt(self, off_m: float, off_mps: float) -> float:
        """Widen position and speed from the next step on; returns the heading [rad].

        Apparent receiver errors, which the wheels caused, are forgotten.
        """
        errors, layout = self.receivers.forgotten(), self._model.layout

        def opened(belief: Belief) -> Belief:
            for i, error in enumerate(errors):
                belief = reset_states(belief, layout.gps_error(i), error.variance_m2)
            belief = open_states(belief, PLACE, np.eye(2) * off_m**2)
            return open_states(belief, slice(SPEED, SPEED + 1), np.eye(1) * off_mps**2)

        self._doubt = opened
        assert self.belief is not None, "doubt before start"
        return float(self.belief.x[YAW])

    def start(self, engine: Filter, alignment: Alignment, first: FilterStep) -> Belief:
        """Start filtering with the belief at the first step."""
        layout = self._model.layout
        forces, turn_error, tuning = self._body.forces(first), self._body.turn_error_radps, self._config.tuning
        belief = start_belief(alignment, first, forces, layout, turn_error, tuning)
        belief = replace(belief, past=nothing_past(layout.n, self._config.smoothing_s))
        self.fusion = Fusion(engine, self._model, belief, relock=tuning.relock)
        return belief

    def filter(self, event: Event) -> list[Belief]:
        """Beliefs that an event changed."""
        fusion = self.fusion
        assert fusion is not None, "filter before start"
        return self._filter_step(fusion, event) if isinstance(event, FilterStep) else self._place(fusion, event)

    def is_accepted(self, fix: Fix) -> bool:
        """Whether the filter accepted this receiver's newest fix."""
        last = self.fusion.last.get(fix.sensor.name) if self.fusion else None
        return last is not None and last.accepted

    def off_m(self, fix: Fix) -> Floats:
        """Innovation of this receiver's newest fix (2,), east and north."""
        last = self.fusion.last.get(fix.sensor.name) if self.fusion else None
        return last.innovation if last else np.zeros(2)

    def _filter_step(self, fusion: Fusion, event: FilterStep) -> list[Belief]:
        """Beliefs that the machine's motion changed.

        Without GPS, wheels and IMUs update neither position, heading nor gyro bias. They show none of these, but the
        centripetal w x v, linearised at jittering values, looks like information: it bends the bias by 0.4 degrees per
        second in ten minutes. Standstills and absolute headings still update all that correlates.
        """
        absolute = self._references.measurements(event, fusion.belief)
        errors = self._references.errors
        layout = fusion.model.layout
        unplaced = layout.wheel_scale and event.stamp_ns - self._placed_ns > self._config.tuning.unplaced_s * 1e9
        reckons = unplaced and bool(self._placed_ns or self._config.is_started)  # else the aligning fix is to come
        # Wheels show nothing of their scale s, but h = (1 + s) v is linearised at a jittering speed.
        considers = tuple(range(layout.wheel_scales.start, layout.wheel_scales.stop))
        if unplaced:
            headed = (YAW, *range(layout.gyro_biases.start, layout.gyro_biases.stop)) if reckons else ()
            considers = (X, Y, Z, *considers, *headed)
        inertial, turn = self._body.inertial(event), self._body.turn(event)
        wheels = self._body.wheels(event, considers)
        if unplaced:
            inertial = [replace(m, considers=considers) for m in inertial]
        fusion.model = fusion.model.driven(errors, event.traction, self._body.slip_std, reckons=reckons)
        beliefs: list[Belief] = []
        for orientation in self._references.own_stamped(event):
            beliefs += self._filter_modal(fusion, self._references, orientation)
        shown = [*inertial, *absolute, *turn, *wheels]
        if self._doubt and shown:
            shown[0], self._doubt = replace(shown[0], change=self._doubt), None
        beliefs += fusion.add(shown) if shown else []
        return beliefs + self._follow_lanes(fusion, event.reckoned)

    def _follow_lanes(self, fusion: Fusion, reckoned: DeadReckonedPose) -> list[Belief]:
        aid = self.lanes
        if aid is None or not aid.is_due(reckoned):
            return []
        if aid.lanes and not fusion.model.layout.lanes:
            layout = replace(fusion.model.layout, lanes=True)
            fusion.extend(replace(fusion.model, layout=layout), aid.variances_m2(reckoned.stamp_ns))
        layout = fusion.model.layout
        beliefs: list[Belief] = []
        for measure in (aid.measurement, aid.slope_measurement):
            if not (measurement := measure(fusion.belief)) or not (changed := fusion.add([measurement])):
                continue
            beliefs += changed
            if not aid.judge(fusion.belief, fusion.last[measurement.sensor].nis / len(measurement.z), layout):
                self._doubt = partial(aid.taken_back, layout=layout)
        return beliefs

    def _place(self, fusion: Fusion, event: Fix | Measurement) -> list[Belief]:
        if isinstance(event, Fix):
            name = event.sensor.name
            before = fusion.counters[f"{name}_relocked"]
            beliefs = self._filter_modal(fusion, self.receivers, event)
            self.has_relocked = fusion.counters[f"{name}_relocked"] > before
        else:
            name, beliefs = event.sensor, fusion.add([event])
        if beliefs and fusion.last[name].accepted:
            self._placed_ns = max(self._placed_ns, event.stamp_ns)
        return beliefs

    def _filter_modal(self, fusion: Fusion, sensors: ModalSensors[Value], value: Value) -> list[Belief]:
        if sensors.needs_anchor(value):
            sensors.anchor(value, fusion.at(value.stamp_ns))
        measurement = sensors.measurement(value)
        if measurement is None:
            return []
        fusion.model = replace(fusion.model, gps_errors=self.receivers.errors)
        beliefs = fusion.add([measurement])
        if beliefs:
            sensors.confirm(value, fusion.last[measurement.sensor])
        return beliefs


def layout_of(machine: MachineConfig) -> Layout:
    """States for slow errors of a machine's sensors."""
    source = turn_source(machine)
    imus = sum(s.kind == "imu" and s.use for s in machine.sensors)
    turns = imus + (source is not None and source.kind != "imu")
    receivers, references = drifting(machine.sensors), heading_references(machine.sensors)
    return Layout(turns, True, len(receivers), len(references))


def gps_velocity(reading: GpsVelocity, sensor: SensorConfig, tuning: LocalisationTuning = TUNING) -> Measurement:
    """Doppler velocity of the antenna in `map`; its variance is the configured one, else its own.

    Code delays hardly affect carrier frequencies, so it lacks the slow errors of fixes and shows heading and wheel
    scale.
    """
    variances = np.array(velocity_variances(reading, sensor))
    z, lever_m = np.array([reading.velocity_e_mps, reading.velocity_n_mps]), np.array(sensor.mount.xyz_m)
    gate = sensor.gate(tuning.gps_gate_sigma)
    return measurements.velocity(reading.stamp_ns, sensor.name, z, np.diag(variances), lever_m, gate)
