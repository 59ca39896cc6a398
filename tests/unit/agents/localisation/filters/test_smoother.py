import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents.localisation import measurements
from agents.localisation.filters.belief import (
    Belief,
    Filter,
    Measurement,
    Motion,
    anchor_states,
    open_states,
    reset_states,
)
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.late_measurements import Fusion
from agents.localisation.filters.motion import GpsError, MotionModel
from agents.localisation.filters.smoother import KEPT, SmoothedPose, nothing_past
from agents.localisation.filters.state import POSITION, RATE, SPEED, YAW, Layout
from agents.localisation.filters.ukf import Ukf
from protocol.arrays import Floats

LAYOUT = Layout(imus=1, wheel_scale=True, receivers=1)
MODEL = MotionModel(LAYOUT, gps_errors=(GpsError(2.0, 30.0),))
START_NS = 1_767_225_600_000_000_000
LEVER_M = np.array([0.8, 0.3, 3.0])
SPEED_MPS, TURN_RADPS = 2.0, 0.15
BOTH = pytest.mark.parametrize("engine", [Ekf(), Ukf()], ids=["ekf", "ukf"])
WHOLE_S = 1000.0  # longer than every run here
Groups = list[list[Measurement]]


def start(lag_s: float = WHOLE_S, yaw: float = 0.7) -> Belief:
    x, deviation = np.zeros(LAYOUT.n), np.full(LAYOUT.n, 0.05)
    x[YAW], x[SPEED], x[RATE.stop - 1] = yaw, SPEED_MPS, TURN_RADPS
    deviation[POSITION], deviation[LAYOUT.wheel_scales], deviation[LAYOUT.gps_errors] = 2.0, 0.03, 1.4
    return Belief(START_NS, x, np.diag(deviation**2), past=nothing_past(LAYOUT.n, lag_s))


def drive(seed: int, seconds: float = 14.0) -> Groups:
    """Noisy measurements in a bend."""
    rng, R = np.random.default_rng(seed), np.diag([1e-5] * 3 + [1.0] * 3)
    groups: Groups = []
    drift_m = rng.normal(size=2)
    for i in range(1, round(seconds * 20)):
        stamp, t = START_NS + i * 50_000_000, i * 0.05
        ahead = np.array([SPEED_MPS * 1.02 + 0.04 * rng.normal(), 0.0, 0.0])
        turn = np.array([0.0, 0.0, TURN_RADPS + 0.003 + 0.003 * rng.normal(), 0.0, SPEED_MPS * TURN_RADPS, 9.81])
        group = [
            measurements.inertial(stamp, "imu", turn, R, np.zeros(3), LAYOUT.gyro_bias(0), 6.0),
            measurements.wheels(stamp, "wheels", ahead, np.eye(3) * 1e-3, LAYOUT.wheel_scales.start, 6.0),
        ]
        groups.append(group)
        if i % 8 == 3:
            yaw = 0.7 + TURN_RADPS * t
            place = SPEED_MPS / TURN_RADPS * np.array([math.sin(yaw) - math.sin(0.7), math.cos(0.7) - math.cos(yaw)])
            c, s = math.cos(yaw), math.sin(yaw)
            place += (
                [c * LEVER_M[0] - s * LEVER_M[1], s * LEVER_M[0] + c * LEVER_M[1]] + drift_m + 0.5 * rng.normal(size=2)
            )
            error = LAYOUT.gps_error(0)
            groups.append([measurements.fix(stamp + 7_000_000, "gps", place, np.eye(2) * 0.25, LEVER_M, error, 4.0)])
    return groups


def fused(engine: Filter, groups: Groups, belief: Belief | None = None) -> tuple[Fusion, list[SmoothedPose]]:
    """Fusion after all measurements, and the final smoothed poses."""
    fusion = Fusion(engine, MODEL, belief or start())
    poses: list[SmoothedPose] = []
    for group in groups:
        fusion.add(group)
        poses += fusion.take_smoothed()
    return fusion, poses


def late(groups: Groups, seed: int) -> Groups:
    """In order of arrival, each up to 0.4 s late."""
    rng = np.random.default_rng(seed)
    return [groups[i] for i in np.argsort([g[0].stamp_ns + rng.uniform(0, 4e8) for g in groups])]


def same(poses: Sequence[SmoothedPose], others: Sequence[SmoothedPose], tolerance: float = 1e-9) -> None:
    assert [p.stamp_ns for p in poses] == [p.stamp_ns for p in others]
    for pose, other in zip(poses, others, strict=True):
        assert (pose.x_m, pose.y_m, pose.heading_rad) == pytest.approx(
            (other.x_m, other.y_m, other.heading_rad), abs=tolerance
        )
        assert pose.covariance_m2 == pytest.approx(other.covariance_m2, abs=tolerance)
        assert pose.correction == pytest.approx(other.correction, abs=tolerance)


class Augmented:
    """A Kalman filter of the state augmented by kept copies of the past."""

    def __init__(self, belief: Belief) -> None:
        self.x, self.P, self.n = belief.x, belief.P, len(belief.x)

    def copy(self) -> None:
        copying = np.concatenate([np.eye(len(self.x)), np.eye(len(self.x))[KEPT]])
        self.x, self.P = copying @ self.x, copying @ self.P @ copying.T

    def map(self, M: Floats, states: slice, Q: Floats) -> None:
        """The error by M (n, n), noise of covariance Q at some states."""
        A = np.eye(len(self.x))
        A[: self.n, : self.n] = M
        self.P = A @ self.P @ A.T
        self.P[states, states] += Q

    def see(self, measurement: Measurement) -> None:
        H = np.concatenate([measurement.jacobian(self.x), np.zeros((len(measurement.z), len(self.x) - self.n))], axis=1)
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + measurement.R)
        self.x, self.P = self.x + K @ (measurement.z - H @ self.x), self.P - K @ H @ self.P


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1), st.lists(st.sampled_from(["move", "see", "reset", "anchor", "open"]), max_size=20))
@BOTH
def test_it_is_the_kalman_filter_of_a_state_that_holds_the_past(engine: Filter, seed: int, steps: list[str]) -> None:
    rng, n, states, Q = np.random.default_rng(seed), 8, slice(6, 8), np.eye(2) * 0.7
    root = rng.normal(size=(n, n))
    belief = Belief(0, rng.normal(size=n), root @ root.T + np.eye(n), past=nothing_past(n, WHOLE_S))
    reference = Augmented(belief)
    for step in ["move", *steps]:
        M, H = np.eye(n), rng.normal(size=(2, n))
        if step == "move":  # after a second the newest state becomes a node
            M = 0.9 * M + 0.2 * rng.normal(size=(n, n))
            moves = Motion(lambda x, F=M: x @ F.T, lambda _, F=M: F, np.eye(n) * 0.1, ())
            belief = engine.predict(belief, moves, belief.stamp_ns + 1_000_000_000)
            reference.copy()
            reference.map(M, slice(n), moves.Q)
            reference.x[:n] = M @ reference.x[:n]
        elif step == "see":
            measured = Measurement(
                "a", 0, rng.normal(size=2), 0.3 * np.eye(2), lambda x, H=H: x @ H.T, lambda _, H=H: H
            )
            belief = engine.condition(belief, measured).belief
            reference.see(measured)
        elif step == "open":
            belief = open_states(belief, states, Q)
            reference.map(M, states, Q)
        else:
            H[:, states], M[states] = 0.0, 0.0
            if step == "reset":
                belief = reset_states(belief, states, 0.7)
            else:
                belief, M[states] = anchor_states(belief, states, H, 0.7), -H
            reference.map(M, states, Q)
            reference.x[states] = 0.0
    assert belief.past is not None
    poses = belief.past.poses(belief.stamp_ns, belief.x, belief.P)
    places = range(n, len(reference.x), 3)
    assert len(poses) == len(places) + 1
    for pose, i in zip(poses, places, strict=False):
        assert (pose.x_m, pose.y_m) == pytest.approx(reference.x[i : i + 2], abs=1e-7), f"{seed=}"
        assert pose.covariance_m2 == pytest.approx(reference.P[i : i + 2, i : i + 2], abs=1e-7), f"{seed=}"


# --- the lag ---------------------------------------------------------------------------------------------------------


@BOTH
def test_the_filter_itself_is_the_same_to_the_last_bit_whatever_the_lag(engine: Filter) -> None:
    groups = late(drive(4, 10.0), 4)
    runs = [Fusion(engine, MODEL, start(lag_s)) for lag_s in (0.0, 3.0, WHOLE_S)]
    for group in groups:
        without, *others = [fusion.add(group) for fusion in runs]
        for beliefs in others:
            for a, b in zip(without, beliefs, strict=True):
                assert a.x.tobytes() == b.x.tobytes()
                assert a.P.tobytes() == b.P.tobytes()
    assert runs[0].belief.past is None
    assert runs[0].take_smoothed() == runs[0].remaining() == []


def test_a_pose_becomes_final_once_with_all_that_was_measured_within_the_lag() -> None:
    """Equal to the newest belief of a run ending there."""
    groups, lag_s = drive(5), 3.0
    fusion, final = fused(Ekf(), groups, start(lag_s))
    poses = final + fusion.remaining()
    assert 5 < len(final) < len(poses) - 3
    assert [p.stamp_ns for p in poses] == sorted({p.stamp_ns for p in poses})
    assert np.diff([p.stamp_ns for p in poses[:-1]]).min() > 0.9e9
    for pose in final[::4]:
        over_ns = next(p.stamp_ns for p in poses if p.stamp_ns >= pose.stamp_ns + lag_s * 1e9)
        ended, _ = fused(Ekf(), [g for g in groups if g[0].stamp_ns <= over_ns])
        same([pose], [p for p in ended.remaining() if p.stamp_ns == pose.stamp_ns])


@BOTH
def test_late_measurements_in_any_order_make_the_same_poses(engine: Filter) -> None:
    groups = drive(6, 12.0)
    in_order, final = fused(engine, groups, start(3.0))
    other, poses = fused(engine, late(groups, 1), start(3.0))
    same(poses + other.remaining(), final + in_order.remaining(), 1e-8)


def test_after_a_gap_longer_than_the_lag_nothing_of_before_waits() -> None:
    groups = [g for g in drive(7, 17.0) if not 5 < (g[0].stamp_ns - START_NS) * 1e-9 < 12]
    fusion, poses = fused(Ekf(), groups, start(3.0))
    final, left = ([(p.stamp_ns - START_NS) * 1e-9 for p in some] for some in (poses, fusion.remaining()))
    assert [s for s in final if s < 12] == sorted(s for s in final + left if s < 12)
    assert len([s for s in final if s < 5.01]) == 6
    assert not [s for s in final if 5.01 < s < 12]


@BOTH
def test_smoothing_never_makes_a_place_less_sure(engine: Filter) -> None:
    groups, filtered = drive(8), {START_NS: start()}
    fusion = Fusion(engine, MODEL, start(5.0))
    for group in groups:
        filtered.update((belief.stamp_ns, belief) for belief in fusion.add(group))
    poses, middle = fusion.take_smoothed() + fusion.remaining(), []
    for pose in poses:
        P = filtered[pose.stamp_ns].P[:2, :2]
        assert np.linalg.eigvalsh(P - pose.covariance_m2)[0] > -1e-12
        assert filtered[pose.stamp_ns].x[:2] + pose.correction[:2] == pytest.approx((pose.x_m, pose.y_m))
        middle.append(np.trace(pose.covariance_m2) / np.trace(P))
    assert np.mean(middle[3:-6]) < 0.9


def test_headings_are_smoothed_across_the_back() -> None:
    """Across +-180 degrees: small corrections, headings in +-pi."""
    belief, groups = start(4.0, yaw=2.9), []
    for i in range(1, 300):
        stamp = START_NS + i * 50_000_000
        turn = measurements.turn(stamp, "turn", TURN_RADPS, 0.003, None, 0.0, 0.0)
        yaw = 2.9 + TURN_RADPS * i * 0.05 + 0.02
        seen = measurements.orientation(stamp, "ahrs", np.array([0.0, 0.0, yaw]), np.eye(3) * 0.01, 6.0)
        groups.append([turn, seen])
    fusion, poses = fused(Ekf(), groups, belief)
    for pose in poses + fusion.remaining():
        true = 2.9 + TURN_RADPS * (pose.stamp_ns - START_NS) * 1e-9 + 0.02
        assert abs(pose.heading_rad) <= math.pi
        assert math.remainder(pose.heading_rad - true, math.tau) == pytest.approx(0.0, abs=0.02)
        assert abs(pose.correction[2]) < 0.1
