import math

import numpy as np
import pytest

from agents.localisation import model
from agents.localisation.model import ModelConfig, Step

DECAY = np.array([0.9, 0.5])
DRIFT_M2 = np.array([1.0, 4.0])


def state(**values: float) -> np.ndarray:
    x = np.zeros(model.BASE_STATES + 4)
    for name, value in values.items():
        x[getattr(model, name)] = value
    return x


def test_move_drives_along_the_middle_heading() -> None:
    moved = model.move(state(HEADING=0.2)[None], Step(2.0, 0.4, 0.1), DECAY)[0]
    assert moved[:2] == pytest.approx((2 * math.cos(0.4), 2 * math.sin(0.4)))
    assert moved[model.HEADING] == pytest.approx(0.6)


def test_gyro_bias_is_taken_off_the_turn_and_wheel_scale_off_the_travel() -> None:
    moved = model.move(state(GYRO_BIAS=0.1, WHEEL_SCALE=0.25)[None], Step(1.0, 0.05, 0.5), DECAY)[0]
    assert moved[model.HEADING] == pytest.approx(0.0)
    assert moved[0] == pytest.approx(0.8, abs=1e-3)


def test_gps_errors_decay_and_nothing_else_changes() -> None:
    x = state()
    x[model.drift_states(0)], x[model.drift_states(1)] = (1.0, 2.0), (3.0, 4.0)
    sigmas = np.stack([x, x + 1])
    moved = model.move(sigmas, Step(0.0, 0.0, 0.1), DECAY)
    assert moved[0, model.BASE_STATES :] == pytest.approx((0.9, 1.8, 1.5, 2.0))
    assert moved[:, model.GYRO_BIAS : model.BASE_STATES].tolist() == sigmas[:, 3:5].tolist()
    assert sigmas[0].tolist() == x.tolist()  # the input is left alone


def test_antenna_lies_ahead_and_left_and_carries_its_own_error() -> None:
    x = state(HEADING=math.pi / 2)
    x[:2], x[model.drift_states(1)] = (10.0, 20.0), (0.1, 0.2)
    assert model.antenna(x[None], (1.0, 0.5), 0)[0] == pytest.approx((9.5, 21.0))
    assert model.antenna(x[None], (1.0, 0.5), 1)[0] == pytest.approx((9.6, 21.2))


def noise(step: Step, heading: float = 0.3, config: ModelConfig | None = None) -> np.ndarray:
    return model.process_noise(step, heading, DECAY, DRIFT_M2, config or ModelConfig())


@pytest.mark.parametrize("step", [Step(0, 0, 0.1), Step(0.4, 0.1, 0.1, 0.01), Step(-0.4, 0, 0.1, 0.01), Step(50, 1, 9)])
def test_process_noise_is_symmetric_and_semidefinite(step: Step) -> None:
    Q = noise(step)
    assert np.array_equal(Q, Q.T)
    assert np.linalg.eigvalsh(Q)[0] > -1e-12


def test_machine_at_rest_gains_no_position_noise() -> None:
    assert not noise(Step(0, 0, 0.1))[model.POSITION, model.POSITION].any()


def test_process_noise_of_the_way_lies_along_the_heading() -> None:
    Q = noise(Step(2.0, 0, 1.0, 0.05), heading=0.0)[model.POSITION, model.POSITION]
    c = ModelConfig()
    assert Q[1, 1] == pytest.approx(c.slip_m2_per_s)
    assert Q[0, 0] == pytest.approx(
        c.slip_m2_per_s + c.travel_share**2 * 2.0 + c.slip_std**2 * 2 * c.slip_time_s * 0.05
    )


def test_process_noise_does_not_depend_on_how_a_step_is_cut() -> None:
    """Only the drift's noise decays within the step, exactly so."""
    whole, half = noise(Step(0.4, 0.0, 0.2, 0.02)), noise(Step(0.2, 0.0, 0.1, 0.01))
    base = slice(0, model.BASE_STATES)
    np.testing.assert_allclose(whole[base, base], 2 * half[base, base])


def test_drift_noise_keeps_the_variance_stationary() -> None:
    Q = np.diag(noise(Step(0, 0, 0.1)))[model.BASE_STATES :]
    decay, variance = np.repeat(DECAY, 2), np.repeat(DRIFT_M2, 2)
    np.testing.assert_allclose(decay**2 * variance + Q, variance)


@pytest.mark.parametrize("name", list(ModelConfig.__dataclass_fields__))
def test_bad_model_option_is_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        ModelConfig(**{name: 0.0})
