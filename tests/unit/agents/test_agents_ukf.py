import numpy as np
import pytest

from agents.localisation.ukf import VectorisedUkf
from protocol.arrays import Floats

F = np.array([[1.0, 0.1, 0.005], [0.0, 1.0, 0.1], [0.0, 0.0, 0.95]])
H = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 1.0]])
Q = np.diag([1e-4, 1e-3, 1e-2])
R = np.diag([0.3, 0.1])


class Kalman:
    """The textbook's linear filter, in Joseph form."""

    def __init__(self, x: Floats, P: Floats) -> None:
        self.x, self.P = x, P

    def predict(self) -> None:
        self.x, self.P = F @ self.x, F @ self.P @ F.T + Q

    def update(self, z: Floats, h: Floats, r: Floats) -> None:
        K = self.P @ h.T @ np.linalg.inv(h @ self.P @ h.T + r)
        rest = np.eye(len(self.x)) - K @ h
        self.x = self.x + K @ (z - h @ self.x)
        self.P = rest @ self.P @ rest.T + K @ r @ K.T


def start() -> tuple[Floats, Floats]:
    return np.array([1.0, -0.5, 0.2]), np.diag([4.0, 1.0, 0.5])


def update(ukf: VectorisedUkf, z: Floats, h: Floats, r: Floats) -> None:
    ukf.condition(*ukf.innovation(z, lambda s: s @ h.T, r))


@pytest.mark.parametrize("alpha", [0.1, 0.5, 1.0])
def test_ukf_equals_the_kalman_filter_on_a_linear_model(alpha: float) -> None:
    seed = 1
    rng = np.random.default_rng(seed)
    ukf, kalman = VectorisedUkf(*start(), alpha=alpha), Kalman(*start())
    for _ in range(200):
        ukf.predict_with(lambda s: s @ F.T, Q)
        kalman.predict()
        if rng.random() < 0.7:
            z = rng.normal(size=2) * 3
            update(ukf, z, H, R)
            kalman.update(z, H, R)
        np.testing.assert_allclose(ukf.x, kalman.x, rtol=1e-7, atol=1e-8, err_msg=f"seed={seed}")
        np.testing.assert_allclose(ukf.P, kalman.P, rtol=1e-7, atol=1e-9, err_msg=f"seed={seed}")


def test_updates_one_after_another_equal_the_stacked_update() -> None:
    z = np.array([2.0, 1.0])
    stacked, single = VectorisedUkf(*start()), VectorisedUkf(*start())
    for ukf in (stacked, single):
        ukf.predict_with(lambda s: s @ F.T, Q)
    update(stacked, z, H, R)
    for i in range(2):
        update(single, z[i : i + 1], H[i : i + 1], R[i : i + 1, i : i + 1])
    np.testing.assert_allclose(single.x, stacked.x, atol=1e-10)
    np.testing.assert_allclose(single.P, stacked.P, atol=1e-10)


def test_innovation_has_mean_and_covariance_of_the_linear_model() -> None:
    x, P = start()
    z = np.array([0.3, 0.7])
    y, S, cross = VectorisedUkf(x, P).innovation(z, lambda s: s @ H.T, R)
    np.testing.assert_allclose(y, z - H @ x, atol=1e-12)
    np.testing.assert_allclose(S, H @ P @ H.T + R, atol=1e-12)
    np.testing.assert_allclose(cross, P @ H.T, atol=1e-12)


def test_start_is_copied() -> None:
    x, P = start()
    ukf = VectorisedUkf(x, P)
    ukf.x[0], ukf.P[0, 0] = 99.0, 99.0
    assert (x[0], P[0, 0]) == (1.0, 4.0)


def test_covariance_stays_symmetric_positive_definite_over_20000_steps_with_dropouts() -> None:
    """A turning vehicle whose position is measured by two receivers in turn, neither of them for long stretches."""
    seed = 7
    rng = np.random.default_rng(seed)
    ukf = VectorisedUkf(np.zeros(4), np.diag([9.0, 9.0, 1.0, 0.01]))

    def move(s: Floats) -> Floats:
        out = s.copy()
        out[:, 2] += 0.1 * (0.3 - s[:, 3])
        out[:, 0] += 0.4 * np.cos(out[:, 2])
        out[:, 1] += 0.4 * np.sin(out[:, 2])
        return out

    def antenna(s: Floats) -> Floats:
        return np.stack([s[:, 0] + 0.8 * np.cos(s[:, 2]), s[:, 1] + 0.8 * np.sin(s[:, 2])], axis=-1)

    noise, white = np.diag([1e-3, 1e-3, 1e-5, 1e-9]), np.eye(2) * 0.25
    truth = np.zeros((1, 4))
    heard = True
    for i in range(20_000):
        truth = move(truth)
        ukf.predict_with(move, noise)
        heard = not heard if rng.random() < 0.01 else heard
        for _ in range(rng.integers(0, 3) if heard else 0):
            z = antenna(truth)[0] + 0.5 * rng.standard_normal(2)
            ukf.condition(*ukf.innovation(z, antenna, white))
        if i % 10 == 0:
            assert np.array_equal(ukf.P, ukf.P.T), f"seed={seed} step={i}"
            assert np.linalg.eigvalsh(ukf.P)[0] > 0, f"seed={seed} step={i}"
    assert np.hypot(*(ukf.x[:2] - truth[0, :2])) < 20, f"seed={seed}"
