"""Receivers with shared errors: machines at rest, many draws, single faults."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from agents.ground_speed import MIN_VELOCITY_STD_MPS
from agents.localisation import measurements
from agents.localisation.consistency import VarianceFactor
from agents.localisation.filters.belief import Belief, Conditioned
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.late_measurements import Fusion
from agents.localisation.filters.motion import MotionModel
from agents.localisation.filters.state import POSITION, SPEED, VELOCITY
from agents.localisation.filters.ukf import Ukf
from agents.localisation.gps import Receivers
from agents.localisation.tracker import gps_velocity, layout_of
from agents.localisation.tuning import TUNING
from protocol.arrays import Floats
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Encoder, Gps, GpsVelocity, Reading
from tests.tiers import by_night
from tests.unit.agents.drives import (
    LEVER_M,
    PROJECTION,
    S_BEND,
    START,
    START_NS,
    TRUE_STEP_S,
    VEHICLE,
    Drive,
    Leg,
    after,
    changed_sensor,
    drive,
    fix,
    localiser,
    machine,
    moved,
    thinned,
)

SECOND = 1_000_000_000
STATED_M2 = 4.0  # of a fix, three quarters slow
PLACE_STD_M = 6.0
ENGINES = {"ekf": Ekf(), "ukf": Ukf()}


def at_rest(vehicle: MachineConfig, errors_m: Floats, place_m: Floats, engine: str = "ekf") -> Belief:
    """Belief of a machine at rest after one fix a second with these errors (n, receivers, 2)."""
    return each_second(vehicle, errors_m, place_m, engine)[-1]


def each_second(vehicle: MachineConfig, errors_m: Floats, place_m: Floats, engine: str = "ekf") -> list[Belief]:
    """Its belief after each second; NaN: no fix."""
    layout = layout_of(vehicle)
    receivers = Receivers(vehicle.sensors, PROJECTION, layout, slow=True, machine_share=vehicle.machine_share)
    reckoned = localiser(vehicle).dead_reckoning.pose
    variance = np.full(layout.n, 1e-6)
    variance[POSITION], variance[VELOCITY] = PLACE_STD_M**2, 1e-4
    model = MotionModel(layout, True, receivers.errors)
    fusion = Fusion(ENGINES[engine], model, Belief(START_NS, np.zeros(layout.n), np.diag(variance)))
    sensors, beliefs = [s for s in vehicle.sensors if s.kind == "gps"], []
    for i, row in enumerate(errors_m):
        stamp = START_NS + (i + 1) * SECOND
        fusion.add([measurements.standstill(stamp)])
        for sensor, error in zip(sensors, row, strict=True):
            if np.isnan(error).any():
                continue
            x, y = place_m + error
            one = receivers.fix(fix(sensor, stamp, float(x), float(y), 0.0, STATED_M2), reckoned)
            if receivers.needs_anchor(one):
                receivers.anchor(one, fusion.at(stamp))
            measurement = receivers.measurement(one)
            if measurement is None:
                continue
            fusion.model = replace(fusion.model, gps_errors=receivers.errors)
            fusion.add([measurement])
            receivers.confirm(one, fusion.last[sensor.name])
            fusion.model = replace(fusion.model, gps_errors=receivers.errors)
        beliefs.append(fusion.belief)
    return beliefs


def sharing(receivers: int, share: float | None, **options: str) -> MachineConfig:
    vehicle = machine(receivers=receivers, machine_share=share)
    for name in [s.name for s in vehicle.sensors if s.kind == "gps"]:
        vehicle = changed_sensor(vehicle, name, **options)
    return vehicle


def test_the_more_is_shared_the_less_is_known_and_all_shared_is_one_receiver() -> None:
    nothing, place = np.zeros((60, 3, 2)), np.zeros(2)
    variance = [at_rest(sharing(3, share), nothing, place).P[0, 0] for share in (0.0, 0.3, 0.6, 0.9, 1.0)]
    assert variance == sorted(variance)
    one = at_rest(sharing(1, None), nothing[:, :1], place).P[0, 0]
    assert variance[0] < 0.5 * one
    assert 0.85 * one < variance[-1] < one


@pytest.mark.slow
@pytest.mark.parametrize(("share", "off_m"), by_night([(0.95, 5.0), (None, 40.0)], day=[(None, 40.0)]))
def test_a_receiver_that_goes_off_for_long_does_not_take_the_place_with_it(share: float | None, off_m: float) -> None:
    """Accepted again as its own error, and once more on return; the others give the place."""
    vehicle = sharing(3, share)
    made = drive([*S_BEND, Leg(18)], vehicle)
    located = localiser(vehicle)
    readings = moved(thinned(made.readings), off_m, "gps-2", from_s=18, to_s=36)
    off = [made.off_m(pose) for pose in located.run(readings)]
    assert max(off) < 1.8
    assert off[-1] < 1.0
    assert located.counters["gps-1_relocked"] == located.counters["gps-3_relocked"] == 0


# --- a wrong return, or a moved machine ------------------------------------------------------------------------------

KNOWN_S, GAP_S = 60, 60
RELOCKED_S = KNOWN_S + GAP_S + TUNING.relock - 1  # second in which the filter accepts them again
DRIFT_S = SensorConfig("gps-1", "gps").drift_time_s


def returning(receivers: int, jumps_m: Floats, seconds: int) -> Floats:
    """Receivers: right, silent for a minute, then off by jumps_m (receivers, 2)."""
    errors = np.zeros((KNOWN_S + GAP_S + TUNING.relock + seconds, receivers, 2))
    errors[KNOWN_S : KNOWN_S + GAP_S] = np.nan
    errors[KNOWN_S + GAP_S :] = jumps_m
    return errors


def outside(belief: Belief, place_m: Floats) -> float:
    """Distance of a place from belief, over the 95 % ellipse."""
    off = belief.x[:2] - place_m
    return math.sqrt(off @ np.linalg.solve(belief.P[:2, :2], off) / 5.99)


def fading(errors_m: Floats) -> Floats:
    """The jump fades like a slow error."""
    errors_m = errors_m.copy()
    seconds = np.arange(len(errors_m) - KNOWN_S - GAP_S)
    errors_m[KNOWN_S + GAP_S :] *= np.exp(-seconds / DRIFT_S)[:, None, None]
    return errors_m


@pytest.mark.parametrize(("engine", "jump_m"), [("ekf", 20.0), ("ukf", 60.0)])
def test_what_a_lone_receiver_is_off_by_is_half_its_own_and_half_the_places(engine: str, jump_m: float) -> None:
    """Undecided: with variance J^2 each, J^2 / 2 remains of either, and both stay possible."""
    vehicle, jump = sharing(1, None), jump_m * np.array([0.6, 0.8])
    beliefs = each_second(vehicle, returning(1, jump, 1), np.zeros(2), engine)
    assert np.hypot(*beliefs[RELOCKED_S - 1].x[:2]) < 0.1  # refused
    belief, along = beliefs[RELOCKED_S], jump / jump_m
    np.testing.assert_allclose(belief.x[:2], jump / 2, rtol=0.01)
    np.testing.assert_allclose(belief.x[layout_of(vehicle).gps_error(0)], jump / 2, rtol=0.01)
    assert math.sqrt(along @ belief.P[:2, :2] @ along) == pytest.approx(math.sqrt(0.5) * jump_m, rel=0.01)
    assert outside(belief, np.zeros(2)) < 1
    assert outside(belief, jump) < 1


@pytest.mark.slow
def test_the_motion_shows_within_seconds_which_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """An error fades against dead reckoning, a wrong place stays. Fixes are noise-free, but state noise."""
    monkeypatch.setattr(VarianceFactor, "note", lambda *_: None)
    jump_m = 60.0
    jump = jump_m * np.array([0.6, 0.8])
    errors = returning(1, jump, 60)
    for readings, true in ((fading(errors), np.zeros(2)), (errors, jump)):
        beliefs = each_second(sharing(1, None), readings, np.zeros(2))[RELOCKED_S:]
        off_m = [math.dist(belief.x[:2], true) for belief in beliefs]
        assert max(off_m[15:]) < 0.1 * jump_m
        assert off_m[45] < 0.03 * jump_m
        assert max(outside(belief, true) for belief in beliefs) < 1


@pytest.mark.slow
@pytest.mark.parametrize(("receivers", "share"), [(3, 0.5), (2, 0.95)])
def test_receivers_that_come_back_alike_move_the_place_at_once(receivers: int, share: float) -> None:
    """A towed or ferried machine."""
    carried = np.array([12.0, -16.0])
    beliefs = each_second(sharing(receivers, share), returning(receivers, carried, 30), np.zeros(2))
    for later_s in (0, 5, 30):
        belief = beliefs[RELOCKED_S + later_s]
        assert math.dist(belief.x[:2], carried) < 1.0
        assert outside(belief, carried) < 1


@pytest.mark.slow
@pytest.mark.parametrize(("share", "engine"), [(0.5, "ukf"), (0.95, "ekf")])
def test_a_second_receiver_says_at_once_which_it_was(share: float, engine: str) -> None:
    """It returns a second after the first's acceptance, right or as far off."""
    jump = np.array([12.0, -16.0])
    for second in (np.zeros(2), jump):
        errors = returning(2, np.array([jump, second]), 30)
        errors[KNOWN_S + GAP_S : RELOCKED_S + 1, 1] = np.nan
        errors = errors if second.any() else fading(errors)
        beliefs = each_second(sharing(2, share), errors, np.zeros(2), engine)[RELOCKED_S:]
        assert 0.25 < math.dist(beliefs[0].x[:2], second) / 20.0 < 0.6
        for belief in beliefs[1:]:
            assert math.dist(belief.x[:2], second) < 1.0
            assert outside(belief, second) < 1


# --- wrong motion: no jump, unknown cause ----------------------------------------------------------------------------

TURNS = (Leg(4, 1.0), *[Leg(3, 0.0, rate) for rate in (0.3, -0.2, 0.25, -0.35)])  # 16 s
WRONG_S = 20


@pytest.mark.slow
def test_a_lone_receiver_is_followed_where_the_wheels_are_stuck() -> None:
    """A constant encoder: dead reckoning stands still while fixes move away."""
    vehicle = sharing(1, None)
    made = drive([*TURNS, Leg(34)], vehicle)
    stuck = next(r for r in made.readings if isinstance(r, Encoder) and after(r, WRONG_S))
    readings = [
        replace(stuck, stamp_ns=r.stamp_ns) if isinstance(r, Encoder) and after(r, WRONG_S) else r
        for r in thinned(made.readings)
    ]
    poses = localiser(vehicle, lag_s=0.0).run(readings)
    assert max(map(made.off_m, poses)) < 20.0


def test_a_receiver_without_a_place_does_not_vote_on_it() -> None:
    """The filter is wrong, or the machine was moved: velocity fits both."""
    vehicle = changed_sensor(sharing(2, None), "gps-2", mode="differential")
    jump = np.array([24.0, -32.0])
    errors = returning(2, jump, 60)
    errors[:, 1] = 0.0  # never silent
    belief = each_second(vehicle, errors, np.zeros(2))[-1]
    assert math.dist(belief.x[:2], jump) < 2.0


def test_results_that_could_not_be_computed_say_nothing_of_a_receiver() -> None:
    """Errors and places stay finite and nobody is outvoted, however many."""
    vehicle = sharing(2, 0.5)
    receivers = Receivers(vehicle.sensors, PROJECTION, layout_of(vehicle), slow=True, machine_share=0.5)
    belief = Belief(START_NS, np.zeros(layout_of(vehicle).n), np.eye(layout_of(vehicle).n))
    one = receivers.fix(fix(vehicle.sensor("gps-1"), START_NS, 0.0, 0.0, 0.0), localiser(vehicle).dead_reckoning.pose)
    before = receivers.measurement(one) and receivers.errors
    nothing = Conditioned(belief, np.full(2, np.nan), np.full((2, 2), np.nan), math.nan, accepted=False)
    for _ in range(40):
        receivers.confirm(one, nothing)
    assert receivers.errors == before


# --- the share -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_share_is_estimated_from_two_absolute_receivers_on_else_as_configured() -> None:
    vehicle = sharing(2, None)
    readings = thinned(drive([*S_BEND, Leg(30)], vehicle).readings)
    estimated = localiser(vehicle)
    first = estimated.machine_share
    estimated.run(readings)  # error-free, hence shared errors
    assert estimated.machine_share > 0.85 > first
    configured = localiser(replace(vehicle, machine_share=0.3))
    configured.run(readings[:1000])
    assert configured.machine_share == 0.3
    assert localiser(machine()).machine_share is None
    assert localiser(vehicle, profile="paper").machine_share is None
    relative = localiser(changed_sensor(vehicle, "gps-2", mode="relative"))
    relative.run(readings[:1000])
    assert relative.machine_share == first


@pytest.mark.slow
def test_two_right_receivers_outvote_a_wrong_one_that_the_filter_believes() -> None:
    """Two are silent as the third jumps and the filter follows; then they return."""
    vehicle = sharing(3, 0.5)
    made = drive([*S_BEND, Leg(20)], vehicle)
    away = [r for r in thinned(made.readings) if r.sensor not in ("gps-1", "gps-3") or not after(r, 18) or after(r, 32)]
    located = localiser(vehicle)
    pose = located.run(moved(away, 60.0, "gps-2", from_s=20))[-1]
    assert located.counters["gps-2_relocked"] >= 1
    assert made.off_m(pose) < 4.0


# --- velocity by Doppler ---------------------------------------------------------------------------------------------

DOPPLER = SensorConfig("doppler", "gps_velocity", Mount(LEVER_M))
WITH_DOPPLER = replace(VEHICLE, sensors=(*VEHICLE.sensors, DOPPLER))
LONG = (*S_BEND, Leg(10), Leg(6, 0, 0.25), Leg(20))


def doppler(made: Drive, seed: int = 0, std_mps: float = 0.0, every: int = 20) -> list[GpsVelocity]:
    """Antenna velocity at 5 Hz on the plane."""
    rng = np.random.default_rng(seed)
    turn = np.gradient(made.heading_rad, TRUE_STEP_S)
    ahead, left = made.speed_mps - turn * LEVER_M[1], turn * LEVER_M[0]
    c, s = np.cos(made.heading_rad), np.sin(made.heading_rad)
    moving = np.stack([c * ahead - s * left, s * ahead + c * left], axis=1)
    moving += std_mps * rng.standard_normal(moving.shape)
    variance = max(std_mps, 0.1) ** 2
    rows = zip(made.stamps_ns[::every], moving[::every].tolist(), strict=True)
    return [GpsVelocity("doppler", stamp, east, north, variance, variance) for stamp, (east, north) in rows]


def merged(*readings: Sequence[Reading]) -> list[Reading]:
    return sorted((r for some in readings for r in some), key=lambda r: r.stamp_ns)


def silenced(readings: Sequence[Reading], from_s: float) -> list[Reading]:
    """Without fixes from then on."""
    return [r for r in readings if not (isinstance(r, Gps) and after(r, from_s))]


def larger_wheels(readings: Sequence[Reading], scale: float) -> list[Reading]:
    """Too many ticks."""
    return [
        replace(r, left_ticks=r.left_ticks * scale, right_ticks=r.right_ticks * scale) if isinstance(r, Encoder) else r
        for r in readings
    ]


def end_error_m(vehicle: MachineConfig, made: Drive, readings: Sequence[Reading]) -> float:
    poses = localiser(vehicle, filter="ekf").run(readings)
    return made.off_m(poses[-1])


def test_a_stated_error_has_a_least_value_and_a_configured_one_counts_as_it_is() -> None:
    reading = GpsVelocity("doppler", 7, 1.0, 2.0, 1e-6, 0.09)
    assert np.diag(gps_velocity(reading, DOPPLER).R) == pytest.approx([MIN_VELOCITY_STD_MPS**2, 0.09])
    configured = replace(DOPPLER, std={"velocity": 0.01})
    assert np.diag(gps_velocity(reading, configured).R) == pytest.approx([1e-4, 1e-4])
    assert gps_velocity(reading, replace(DOPPLER, gate_sigma=9.0)).gate_sigma == 9.0


@pytest.mark.nightly
@pytest.mark.slow
def test_it_holds_the_position_while_fixes_are_away_and_the_wheels_are_wrong() -> None:
    """A scale error of a tenth is beyond the prior of the wheels."""
    made = drive(LONG, WITH_DOPPLER)
    blind = silenced(larger_wheels(thinned(made.readings), 1.1), 20.0)
    alone = end_error_m(WITH_DOPPLER, made, blind)
    aided = end_error_m(WITH_DOPPLER, made, merged(blind, doppler(made)))
    assert aided < 1.0
    assert aided < 0.5 * alone


def test_without_a_fix_and_without_a_start_there_is_no_pose_and_with_a_start_there_is() -> None:
    made = drive((Leg(4, 0.5), Leg(6)), WITH_DOPPLER, without=("gps-1",))
    readings = merged(made.readings, doppler(made))
    assert localiser(WITH_DOPPLER, filter="ekf").run(readings) == []
    located = localiser(WITH_DOPPLER, filter="ekf", start=START)
    pose = located.run(readings)[-1]
    assert made.off_m(pose) < 0.5
    assert located.belief.x[SPEED] == pytest.approx(2.0, abs=0.05)
    assert pose.stamp_ns > START_NS
