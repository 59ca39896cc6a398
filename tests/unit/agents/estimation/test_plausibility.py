"""Every reason to withhold, with its threshold."""

import math
from collections.abc import Iterable
from dataclasses import replace

import pytest

from agents.estimation.balance import Balance
from agents.estimation.plausibility import Plausibility
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.ground import STEADY, after


def reasons(steps: Iterable[Balance]) -> list[str]:
    """With each balance's own resistance."""
    plausibility = Plausibility()
    return [plausibility.judge(b, b.direction * b.unbalanced) for b in steps]


def reason_of(**changes: float) -> str:
    return reasons([replace(STEADY, **changes)])[0]  # type: ignore[arg-type]


def at_work(seconds: float, gain: float = 1.0, offset: float = 0.0, c_rr: float = 0.04) -> list[Balance]:
    """A loader starting, stopping and climbing, with torque gain and offset."""
    judged = []
    for i in range(round(seconds / 0.05)):
        taken = 0.1 * math.sin(0.4 * i * 0.05) + 0.05 * math.sin(1.1 * i * 0.05)
        share = gain * (taken + c_rr) + offset
        moves = {"accel_mps2": GRAVITY_MPS2 * taken, "body_mps2": GRAVITY_MPS2 * taken}
        judged.append(after(i, share=share, unbalanced=share - taken, **moves))
    return judged


def test_a_loader_at_work_is_believed() -> None:
    assert set(reasons(at_work(300))) == {""}


CASES = [  # change of the steady balance, reason
    ({"norm_mps2": 1.0}, "accelerometer"),  # in g
    ({"norm_mps2": 9810.0}, "accelerometer"),  # in mm/s2
    ({"wheels_s": 0.6}, "no_wheels"),
    ({"torque_s": math.inf}, "no_torque"),
    ({"share": 1.3}, "torque_implausible"),
    ({"speed_mps": 0.14}, "standstill"),  # wheel speed error 0.05 m/s
    ({"speed_mps": 0.04, "speed_std_mps": 0.001}, "standstill"),
    ({"speed_mps": 0.5, "speed_std_mps": 0.2}, "standstill"),  # few ticks per turn
    ({"pitch_radps": 0.03}, "pitch_transient"),
    ({"pitch_radps": -0.03, "speed_mps": 0.5}, "pitch_transient"),
    ({"pitch_radps": 0.11, "speed_mps": 8.0}, "pitch_transient"),
    ({"accel_mps2": -1.6, "body_mps2": -1.6, "share": 0.019}, "braking"),  # coasting, torque sensor with a zero
    ({"accel_mps2": 1.6, "body_mps2": 1.6, "speed_mps": -2.0, "unbalanced": -0.04}, "braking"),
    ({"unbalanced": 0.46}, "digging"),
    ({"unbalanced": -0.46, "speed_mps": -2.0}, "digging"),
    ({"accel_mps2": 8.0}, "slip"),  # low-passed: a sixth counts at once
    ({"body_mps2": 8.0}, "slip"),
    # faults first; a standing machine is not braking
    ({"norm_mps2": 0.0, "torque_s": 9.0, "speed_mps": 0.0}, "accelerometer"),
    ({"speed_mps": 0.1, "accel_mps2": -3.0, "pitch_radps": 0.1}, "standstill"),
    # below the thresholds
    ({"speed_mps": 0.16}, ""),
    ({"speed_mps": 0.06, "speed_std_mps": 0.001}, ""),  # a paver
    ({"pitch_radps": 0.025}, ""),
    ({"pitch_radps": 0.1, "speed_mps": 8.0}, ""),  # the crown of 2 m/s at four times the speed
    ({"accel_mps2": 1.6, "body_mps2": 1.6}, ""),  # accelerates
    ({"accel_mps2": -1.6, "body_mps2": -1.6, "share": 0.03, "unbalanced": 0.25}, ""),  # pulls, slowed by sand
    ({"accel_mps2": 1.6, "body_mps2": 1.6, "speed_mps": -2.0, "share": -0.03, "unbalanced": -0.25}, ""),  # in reverse
    ({"accel_mps2": -1.4, "body_mps2": -1.4}, ""),
    ({"unbalanced": 0.44}, ""),
    ({"unbalanced": -0.44}, ""),  # forwards: not digging
    ({"wheels_s": 0.4, "torque_s": 0.4}, ""),
    ({"share": 1.19}, ""),
    ({"accel_mps2": 1.0, "body_mps2": 1.9}, ""),
]


@pytest.mark.parametrize(("changes", "reason"), CASES)
def test_reason_of_one_balance(changes: dict[str, float], reason: str) -> None:
    assert reason_of(**changes) == reason


# --- delays ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"accel_mps2": -2.0, "body_mps2": -2.0, "share": 0.0}, "braking"),
        ({"unbalanced": 0.6}, "digging"),
        ({"accel_mps2": 8.0}, "slip"),
    ],
)
def test_forces_settle_for_half_a_second(options: dict[str, float], reason: str) -> None:
    steps = [after(0, **options), *(after(i) for i in range(1, 60))]
    longer = {"slip": 0.3}.get(reason, 0.0)  # decay of the mean [s]
    assert 0.45 < 0.05 * reasons(steps).count(reason) < 0.56 + longer


def test_a_jolt_of_one_step_is_no_slip_but_spinning_wheels_are() -> None:
    jolted = [after(0), after(1, accel_mps2=2.5), *(after(i) for i in range(2, 20))]
    assert set(reasons(jolted)) == {""}
    spinning = [after(i, accel_mps2=1.5) for i in range(40)]
    assert reasons(spinning).index("slip") == pytest.approx(6, abs=2)  # -0.3 s ln(1 - 1/1.5)


def frozen(seconds: float, swing: float, share: float = 0.1, every_s: float = 4.0) -> list[Balance]:
    """Constant torque with an inertia force of this swing."""
    steps = range(round(seconds / 0.05))
    takes = [share - 0.04 + swing / 2 * math.sin(2 * math.pi * i * 0.05 / every_s) for i in steps]
    return [after(i, share=share, unbalanced=share - taken) for i, taken in zip(steps, takes, strict=True)]


def test_torque_that_stays_the_same_while_motion_changes_is_frozen() -> None:
    judged = reasons(frozen(10, 0.08))
    assert set(reasons(frozen(10, 0.02))) == {""}, "a small change of the motion is no proof"
    begins = judged.index("torque_frozen") * 0.05
    assert 2.0 <= begins < 4.0
    assert set(judged[:40]) == {""}
    assert set(judged[100:]) == {"torque_frozen"}


def test_frozen_torque_that_moves_again_is_believed_at_once() -> None:
    steps = frozen(10, 0.08)
    again = [after(len(steps) + i, share=0.11 + 0.001 * (i % 7), unbalanced=0.04) for i in range(40)]
    assert set(reasons([*steps, *again])[len(steps) :]) == {""}


def test_torque_that_stays_the_same_at_a_standstill_or_steadily_is_not_frozen() -> None:
    standing = [replace(b, speed_mps=0.0) for b in frozen(20, 0.3)]
    assert set(reasons(standing)) == {"standstill"}
    assert set(reasons(frozen(60, 0.0))) == {""}


def test_sand_that_slows_a_machine_down_does_not_look_like_a_wrong_unit() -> None:
    """More force while slowing down, less while speeding up behind it."""
    steps = []
    for i in range(4000):
        phase = i % 400  # 20 s: 4 s of sand, 4 s of speeding up
        c, taken = (0.25, -0.12) if phase < 80 else (0.02, 0.12) if phase < 160 else (0.02, 0.0)
        steps.append(after(i, share=c + taken, unbalanced=c, accel_mps2=9.81 * taken, body_mps2=9.81 * taken))
    assert set(reasons(steps)) == {""}


@pytest.mark.parametrize(
    ("gain", "is_plausible"), [(0.36, False), (0.5, True), (2.0, True), (2.8, False), (1e3, False), (-1, False)]
)
def test_torque_in_a_wrong_unit_is_implausible_and_a_gain_within_its_limits_is_believed(
    gain: float, is_plausible: bool
) -> None:
    assert ("torque_implausible" not in reasons(at_work(60, gain))) is is_plausible


def test_a_unit_that_is_put_right_is_believed_again_after_a_while() -> None:
    """Three times too large: the evidence fades within minutes."""
    wrong, right = at_work(120, 3.0), [replace(b, stamp_ns=b.stamp_ns + 120 * 10**9) for b in at_work(400)]
    judged = reasons([*wrong, *right])[len(wrong) :]
    assert judged[0] == "torque_implausible"
    assert judged[-1] == ""
