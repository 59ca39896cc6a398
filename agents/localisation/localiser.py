"""The localiser: readings in, poses out. Until it knows its heading it only collects."""

from collections import Counter, deque
from dataclasses import replace

from agents.dead_reckoning import DeadReckoning, turn_source
from agents.localisation.alignment import Alignment, align_fixes, align_start, start_belief
from agents.localisation.config import LocalisationConfig
from agents.localisation.consistency import Consistency
from agents.localisation.filters.belief import Belief, Filter, PoseBelief
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.history import Fusion
from agents.localisation.filters.motion import MotionModel
from agents.localisation.filters.state import YAW, Layout
from agents.localisation.filters.ukf import Ukf
from agents.localisation.gps import Fix, Receivers
from agents.localisation.headings import References
from agents.localisation.imu_steps import FilterStep, StepGatherer
from agents.localisation.layout import layout_of, shows_tilt
from agents.localisation.motion_sensors import MotionSensors
from agents.localisation.sensor_modes import ModalSensors, Value
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Gps, Reading
from protocol.rotations import wrap_angle
from protocol.site.site_config import Projection

STEP_S = 0.05  # time step of the filter; its cost grows with the inverse
COLLECTED = 24_000  # steps and fixes kept while the heading is unknown: 20 minutes; a machine that waits needs no more
ENGINES: dict[str, Filter] = {"ekf": Ekf(), "ukf": Ukf()}


class Localiser:
    """Fuses GPS, IMUs and wheels over 15 states and the sensors' slow errors; takes readings in nearly any order."""

    def __init__(
        self, machine: MachineConfig, projection: Projection, config: LocalisationConfig, step_s: float = STEP_S
    ) -> None:
        self._config = config
        augmented = config.profile == "default"
        layout = layout_of(machine) if augmented else Layout()
        self._gatherer = StepGatherer(machine, step_s, orients=not augmented)
        self._receivers = Receivers(machine.sensors, projection, layout, slow=augmented)
        self._references = References(machine.sensors, layout)
        self._body = MotionSensors(machine, layout, step_s, config.slip, config.slip_soft)
        source, on_plane = turn_source(machine), not shows_tilt(machine, config.profile)
        turn_error = self._body.turn_error_radps if augmented and source and source.kind == "odometry" else 0.0
        self._model = MotionModel(layout, on_plane, self._receivers.errors, turn_error_radps=turn_error)
        self._fusion: Fusion | None = None
        self._steps: deque[FilterStep] = deque(maxlen=COLLECTED)
        self._fixes: deque[Fix] = deque(maxlen=COLLECTED)

    @property
    def is_aligned(self) -> bool:
        """Whether the heading is known."""
        return self._fusion is not None

    @property
    def counters(self) -> Counter[str]:
        """Measurements used and gated, readings refused."""
        return self._body.counters + self._gatherer.counters + (self._fusion.counters if self._fusion else Counter())

    @property
    def consistency(self) -> dict[str, Consistency]:
        """How consistent the filter is with each GPS receiver, of those with enough fixes."""
        return self._receivers.consistency

    @property
    def belief(self) -> Belief | None:
        """The whole state, once it is known."""
        return self._fusion.belief if self._fusion else None

    def update(self, reading: Reading, sensor: SensorConfig, dead_reckoning: DeadReckoning) -> list[PoseBelief]:
        """Take in one reading, after dead reckoning did; returns poses that it made possible or changed, in order."""
        event: FilterStep | Fix | None = (
            self._receivers.fix(reading, dead_reckoning.pose)
            if isinstance(reading, Gps)
            else self._gatherer.gather(reading, sensor, dead_reckoning)
        )
        if event is None:
            return []
        beliefs = self._filter(self._fusion, event) if self._fusion else self._collect(event, dead_reckoning.distance_m)
        return [_pose(belief, dead_reckoning.wheels.speed_mps) for belief in beliefs]

    def _filter(self, fusion: Fusion, event: FilterStep | Fix) -> list[Belief]:
        """Beliefs that an event changed."""
        if isinstance(event, Fix):
            return self._filter_modal(fusion, self._receivers, event)
        fusion.model = replace(fusion.model, traction=event.traction)
        beliefs: list[Belief] = []
        for orientation in self._references.own_stamped(event):
            beliefs += self._filter_modal(fusion, self._references, orientation)
        measurements = [
            *self._body.inertial(event),
            *self._references.measurements(event),
            *self._body.turn(event),
            *self._body.wheels(event),
        ]
        return beliefs + (fusion.add(measurements) if measurements else [])

    def _filter_modal(self, fusion: Fusion, sensors: ModalSensors[Value], value: Value) -> list[Belief]:
        """Filter a value whose sensor may count from what is believed at its stamp."""
        if sensors.needs_anchor(value):
            sensors.anchor(value, fusion.at(value.stamp_ns))
        measurement = sensors.measurement(value)
        if measurement is None:
            return []
        fusion.model = replace(fusion.model, gps_errors=self._receivers.errors)
        beliefs = fusion.add([measurement])
        if beliefs:
            sensors.confirm(value, fusion.last[measurement.sensor])
        return beliefs

    def _collect(self, event: FilterStep | Fix, distance_m: float) -> list[Belief]:
        """Keep an event until the heading is known, then filter all that was kept."""
        alignment: Alignment | None = None
        if isinstance(event, Fix):
            self._fixes.append(event)
            alignment = align_fixes(self._fixes, distance_m) if self._steps else None
        else:
            self._steps.append(event)
            alignment = align_start(self._config.start, self._steps[0].reckoned) if self._config.start else None
        return self._start(alignment) if alignment else []

    def _start(self, alignment: Alignment) -> list[Belief]:
        first, layout = self._steps[0], self._model.layout
        belief = start_belief(alignment, first, self._body.forces(first), layout, self._body.turn_error_radps)
        self._fusion = Fusion(ENGINES[self._config.filter], self._model, belief)
        beliefs = [belief]
        events: list[FilterStep | Fix] = [*list(self._steps)[1:], *self._fixes]
        for event in sorted(events, key=lambda e: e.stamp_ns):
            beliefs += self._filter(self._fusion, event)
        self._steps.clear()
        self._fixes.clear()
        return beliefs


def _pose(belief: Belief, speed_mps: float) -> PoseBelief:
    x, y, heading = float(belief.x[0]), float(belief.x[1]), wrap_angle(float(belief.x[YAW]))
    return PoseBelief(belief.stamp_ns, x, y, heading, speed_mps, belief.P[:2, :2].copy())
