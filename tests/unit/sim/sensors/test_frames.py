import numpy as np

from protocol.machine.machine_config import Mount
from protocol.rotations import quaternion_from_rpy
from sim.sensors.frames import compose, cross, map_from_base, rotation, seen_turned, turned

ROLL, PITCH, YAW = 0.1, -0.3, 2.0
ONE = (np.array([YAW]), np.array([PITCH]), np.array([ROLL]))
VECTOR = np.array([0.3, -0.5, 0.9])


def matrix(roll: float, pitch: float, yaw: float) -> np.ndarray:
    return Mount(rpy_deg=tuple(np.degrees([roll, pitch, yaw]))).frame_from_sensor()


def rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The vector part of q v q*."""
    inverse = q * np.array([-1, -1, -1, 1]).reshape(4, *[1] * (q.ndim - 1))
    whole = np.concatenate([v, np.zeros((1, *v.shape[1:]))])
    return compose(compose(q, whole), inverse)[:3]


def test_frames_agree_with_the_mounts_rotation() -> None:
    turn = matrix(ROLL, PITCH, YAW)
    np.testing.assert_allclose(map_from_base(VECTOR[:, None], *ONE)[:, 0], turn @ VECTOR)
    np.testing.assert_allclose(rotate(quaternion_from_rpy(*ONE[::-1]), VECTOR[:, None])[:, 0], turn @ VECTOR)


def test_quaternions_compose_like_matrices() -> None:
    first, second = quaternion_from_rpy(-0.4, 0.2, 1.0), quaternion_from_rpy(3.0, 0.5, -0.7)
    expected = matrix(-0.4, 0.2, 1.0) @ matrix(3.0, 0.5, -0.7) @ VECTOR
    np.testing.assert_allclose(rotate(compose(first, second), VECTOR), expected)


def test_products_agree_with_numpys() -> None:
    rng = np.random.default_rng(3)
    a, b, m = rng.standard_normal((3, 4, 5)), rng.standard_normal((3, 4, 5)), rng.standard_normal((3, 3, 5))
    np.testing.assert_allclose(cross(a, b), np.cross(a, b, axis=0))
    np.testing.assert_allclose(turned(m, a), np.einsum("iju,jru->iru", m, a))


def test_turned_axes_see_what_the_rotation_says() -> None:
    np.testing.assert_allclose(seen_turned(np.array(YAW), VECTOR), matrix(0, 0, YAW).T @ VECTOR)
    np.testing.assert_allclose(rotation(np.array([0, 0, YAW])), matrix(0, 0, YAW), atol=1e-15)
    np.testing.assert_allclose(rotation(np.array([0, PITCH, 0])), matrix(0, PITCH, 0), atol=1e-15)
    np.testing.assert_array_equal(rotation(np.zeros(3)), np.eye(3))
    tilt = rotation(np.array([0.4, -0.7, 0.2]))
    np.testing.assert_allclose(tilt @ tilt.T, np.eye(3), atol=1e-15)
