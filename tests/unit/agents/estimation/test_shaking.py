"""Shaking machines: gates, and the estimator's longer steps."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from agents.estimation.balance import Balance
from agents.estimation.plausibility import Plausibility
from agents.estimation.shaking import LONG_S, LongerSteps
from protocol.units import GRAVITY_MPS2
from tests.unit.agents.ground import STEP_S, after, level_steps

SEEDS = (0, 1)
LONG = int(LONG_S / STEP_S)


def shaken(steps: Sequence[Balance], force_mps2: float, rate_radps: float, seed: int) -> list[Balance]:
    """Add stationary shaking, ahead and in pitch."""
    rng = np.random.default_rng(seed)
    moved, turned = (np.diff(rng.standard_normal(len(steps) + 1)) / math.sqrt(2) for _ in range(2))
    return [
        replace(
            b,
            unbalanced=b.unbalanced - force_mps2 * m / GRAVITY_MPS2,
            body_mps2=b.body_mps2 + force_mps2 * m,
            norm_mps2=b.norm_mps2 + force_mps2 * t,
            pitch_radps=b.pitch_radps + rate_radps * t,
        )
        for b, m, t in zip(steps, moved, turned, strict=True)
    ]


def at_work(seconds: float, gain: float = 1.0) -> list[Balance]:
    """A machine starting, stopping and climbing, with a torque gain."""
    steps = []
    for i in range(round(seconds / 0.05)):
        accel, climb = 0.05 * math.sin(0.4 * i * 0.05), 0.08 * math.sin(0.05 * i * 0.05)
        share = gain * (accel + climb + 0.04)
        moves = {"accel_mps2": GRAVITY_MPS2 * accel, "body_mps2": GRAVITY_MPS2 * accel, "slope_x": climb}
        steps.append(after(i, share=share, unbalanced=share - accel - climb, **moves))
    return steps


def reasons(steps: Sequence[Balance]) -> list[str]:
    plausibility = Plausibility(3.3)
    return [plausibility.judge(b, b.direction * b.unbalanced) for b in steps]


def share_of(reason: str, judged: Sequence[str]) -> float:
    return judged.count(reason) / len(judged)


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("force_mps2", "rate_radps", "least"), [(0.5, 0.03, 0.97), (0.9, 0.1, 0.95), (2.2, 0.15, 0.9)])
def test_a_machine_that_shakes_is_believed(force_mps2: float, rate_radps: float, least: float, seed: int) -> None:
    judged = reasons(shaken(at_work(120), force_mps2, rate_radps, seed))[100:]  # after 5 s, the time to measure it
    assert share_of("", judged) > least, f"{seed=} {set(judged)}"
    assert "torque_implausible" not in judged


@pytest.mark.parametrize("gain", [1000.0, 1 / 1000, 0.3, 3.0, -1.0])
@pytest.mark.parametrize("force_mps2", [0.9, 2.2])
def test_a_wrong_unit_is_found_on_a_machine_that_shakes(gain: float, force_mps2: float) -> None:
    judged = reasons(shaken(at_work(240, gain), force_mps2, 0.1, seed=0))
    assert judged[-1] == "torque_implausible"
    assert share_of("torque_implausible", judged) > 0.6


@pytest.mark.parametrize("seed", SEEDS)
def test_shaking_alone_shows_nothing_of_the_torques_unit(seed: int) -> None:
    """At steady speed on level ground, noise on one side alone made the slope 0."""
    level = [after(i, share=0.06 + 0.01 * math.sin(i * 0.02), unbalanced=0.06) for i in range(6000)]
    assert "torque_implausible" not in reasons(shaken(level, 2.2, 0.1, seed)), f"{seed=}"


@pytest.mark.parametrize("rate_radps", [0.0, 0.1])
def test_a_ramps_foot_is_withheld_whether_or_not_the_machine_shakes(rate_radps: float) -> None:
    """15 degrees over a wheelbase of 3.3 m, 2 m/s."""
    level = [after(i) for i in range(400)]
    ramp = [after(400 + i, pitch_radps=math.radians(15) * 2 / 3.3) for i in range(33)]
    judged = reasons(shaken([*level, *ramp], 0.9 if rate_radps else 0.0, rate_radps, seed=0))
    assert share_of("pitch_transient", judged[410:]) > 0.9
    assert share_of("pitch_transient", judged[100:400]) < 0.05


def test_slip_and_digging_are_found_on_a_machine_that_shakes() -> None:
    spinning = [*at_work(20), *(after(400 + i, accel_mps2=6.0) for i in range(40))]
    assert reasons(shaken(spinning, 0.9, 0.05, seed=0))[-1] == "slip"
    digging = [*at_work(20), *(after(400 + i, unbalanced=1.0) for i in range(40))]
    assert reasons(shaken(digging, 0.9, 0.05, seed=0))[-1] == "digging"


# --- longer steps ----------------------------------------------------------------------------------------------------


def test_steps_are_joined_while_a_machine_shakes_and_nothing_is_lost() -> None:
    steps, longer = level_steps(np.arange(2.0 * LONG)), LongerSteps()
    ready = [made for step in steps for made in longer.add(step, shakes=True)]
    assert [made.stamp_ns for made in ready] == [steps[LONG - 1].stamp_ns, steps[-1].stamp_ns]
    assert [made.raw for made in ready] == pytest.approx([(LONG - 1) / 2, LONG + (LONG - 1) / 2])
    for name in ("dt_s", "distance_m"):
        assert sum(getattr(made, name) for made in ready) == pytest.approx(sum(getattr(s, name) for s in steps))


def test_steps_of_a_quiet_machine_pass_as_they_are() -> None:
    steps, longer = level_steps([0.04] * 5), LongerSteps()
    assert [made for step in steps for made in longer.add(step, shakes=False)] == steps


@pytest.mark.parametrize("change", ["pause", "direction"])
def test_steps_that_do_not_follow_one_another_are_not_joined(change: str) -> None:
    first, second = level_steps([0.04, 0.05])
    late_ns = second.stamp_ns + 10**9 if change == "pause" else second.stamp_ns
    second = replace(second, stamp_ns=late_ns, regressor=-1.0 if change == "direction" else 1.0)
    longer = LongerSteps()
    assert longer.add(first, shakes=True) == []
    assert longer.add(second, shakes=True) == [first]
