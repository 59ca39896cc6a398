"""Rotations against SciPy's, single and as arrays."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from protocol.rotations import matrix_from_quaternion, matrix_from_rpy, quaternion_from_rpy, rpy_from_matrix, wrap_angle

RPY = np.random.default_rng(5).uniform((-3.1, -1.5, -3.1), (3.1, 1.5, 3.1), (200, 3)).T


def test_matrices_are_those_of_scipy():
    reference = Rotation.from_euler("ZYX", RPY[::-1].T).as_matrix()
    np.testing.assert_allclose(np.moveaxis(matrix_from_rpy(*RPY), 2, 0), reference, atol=1e-15)


def test_angles_come_back():
    np.testing.assert_allclose(rpy_from_matrix(matrix_from_rpy(*RPY)), RPY, atol=1e-12)


def test_quaternions_are_those_of_scipy_but_for_their_sign():
    own = quaternion_from_rpy(*RPY)
    reference = Rotation.from_euler("ZYX", RPY[::-1].T).as_quat().T
    np.testing.assert_allclose(own * np.sign((own * reference).sum(axis=0)), reference, atol=1e-15)


def test_quaternions_of_any_length_are_rotations():
    np.testing.assert_allclose(matrix_from_quaternion(3 * quaternion_from_rpy(*RPY)), matrix_from_rpy(*RPY), atol=1e-14)


@pytest.mark.parametrize(("angle", "wrapped"), [(0.0, 0.0), (np.pi, -np.pi), (-np.pi, -np.pi), (7.0, 7.0 - 2 * np.pi)])
def test_angles_are_wrapped_to_half_a_turn(angle, wrapped):
    assert wrap_angle(angle) == pytest.approx(wrapped)
    assert wrap_angle(np.array([angle]))[0] == pytest.approx(wrapped)
