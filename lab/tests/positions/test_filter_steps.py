"""What led to a belief: motions, changes, and the measurements that were accepted."""

import numpy as np
import pytest

from agents.localisation.filters.belief import Belief, Measurement, Motion, anchor_states, open_states, reset_states
from agents.localisation.filters.ekf import Ekf
from lab.positions.filter_steps import LinearChange, StepRecorder, linear_change
from protocol.arrays import Floats

N = 6
STATES = slice(4, 6)


def believed(seed: int = 1) -> Belief:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N, N))
    return Belief(0, rng.normal(size=N), root @ root.T + np.eye(N))


def motion(F: Floats) -> Motion:
    return Motion(lambda states: states @ F.T, lambda _: F, np.eye(N) * 0.1, ())


def measured(z: float, gate: float = 0.0) -> Measurement:
    H = np.eye(N)[:2]
    return Measurement("a", 0, np.full(2, z), np.eye(2), lambda x: x @ H.T, lambda _: H, gate_sigma=gate)


def test_it_filters_as_the_filter_does_and_notes_what_counted() -> None:
    recorder, plain, belief = StepRecorder(Ekf()), believed(), believed()
    for i in range(1, 4):
        plain, belief = (
            kind.predict(b, motion(0.9 * np.eye(N)), i) for kind, b in ((Ekf(), plain), (recorder, belief))
        )
        recorder.predict(belief, motion(np.eye(N)), 9)  # asked, and not gone on with
        assert not recorder.condition(belief, measured(100.0, gate=3.0)).accepted
        plain = Ekf().condition(plain, measured(0.5)).belief
        belief = recorder.condition(belief, measured(0.5)).belief
    assert belief.x.tobytes() == plain.x.tobytes()
    steps = recorder.steps(belief)
    assert [type(step.what) for step in steps] == [Belief, *([Motion, Measurement] * 3)]
    assert [step.stamp_ns for step in steps] == [0, 1, 1, 2, 2, 3, 3]
    assert steps[-1].x is belief.x
    with pytest.raises(ValueError, match="another run"):
        recorder.steps(plain)


H = np.random.default_rng(3).normal(size=(2, N)) * (np.arange(N) < 4)


@pytest.mark.parametrize(
    ("changed", "M", "V"),
    [
        (lambda b: reset_states(b, STATES, 0.7), np.zeros((2, 4)), 0.7 * np.eye(2)),
        (lambda b: anchor_states(b, STATES, H, 0.7), -H[:, :4], 0.7 * np.eye(2)),
        (lambda b: open_states(b, STATES, 3 * np.eye(2)), None, 3 * np.eye(2)),
    ],
    ids=["reset", "anchor", "open"],
)
def test_a_change_is_recognised_as_a_linear_map_and_noise(changed, M, V) -> None:
    before = believed()
    after = changed(before)
    change = linear_change(before, after)
    assert change
    assert change.V[STATES, STATES] == pytest.approx(V)
    assert change.M @ before.x + change.c == pytest.approx(after.x)
    assert pytest.approx(after.P) == change.M @ before.P @ change.M.T + change.V
    if M is not None:
        assert change.M[STATES, :4] == pytest.approx(M)


def test_a_change_stands_between_the_steps_around_it() -> None:
    recorder, belief = StepRecorder(Ekf()), believed()
    belief = recorder.predict(belief, motion(np.eye(N)), 1)
    belief = recorder.condition(reset_states(belief, STATES, 0.7), measured(1.0)).belief
    assert [type(step.what) for step in recorder.steps(belief)] == [Belief, Motion, LinearChange, Measurement]


def test_another_belief_altogether_is_no_change() -> None:
    assert linear_change(believed(1), believed(2)) is None
    recorder = StepRecorder(Ekf())
    recorder.predict(believed(1), motion(np.eye(N)), 1)
    with pytest.raises(ValueError, match="cannot be followed"):
        recorder.condition(believed(2), measured(1.0))
