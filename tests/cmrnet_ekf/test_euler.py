import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from cmrnet_ekf import euler
from lcd_common import se3


def angles(count: int = 50) -> np.ndarray:
    rng = np.random.default_rng(0)
    return rng.uniform([-3, -1.5, -3], [3, 1.5, 3], (count, 3))


def test_rotations_are_scipys():
    expected = Rotation.from_euler('ZYX', angles()[:, ::-1])
    np.testing.assert_allclose(euler.rotations(angles()), expected.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(euler.euler_angles(expected.as_matrix()), angles(), atol=1e-9)


def test_quaternions_are_scipys():
    found = euler.quaternion_of_euler(torch.tensor(angles()))
    expected = Rotation.from_euler('ZYX', angles()[:, ::-1])
    sign = np.sign((found.numpy() * expected.as_quat()).sum(1, keepdims=True))
    np.testing.assert_allclose(found.numpy() * sign, expected.as_quat(), atol=1e-12)
    np.testing.assert_allclose(euler.euler_of_quaternion(found).numpy(), angles(), atol=1e-7)


def test_components_and_transforms_are_inverse():
    c = np.concatenate([angles(), angles()], 1)
    np.testing.assert_allclose(euler.components(euler.transforms(c)), c, atol=1e-9)


def test_the_jacobian_is_that_of_finite_differences():
    c, step = np.array([0.3, -1.0, 2.0, 0.4, -0.7, 2.5]), 1e-6
    J = euler.jacobian_to_body(c)
    inverse = se3.inverse(euler.transforms(c))
    for k in range(6):
        change = np.zeros(6)
        change[k] = step
        moved = se3.log(inverse @ euler.transforms(c + change)) / step
        np.testing.assert_allclose(J[:, k], moved, atol=1e-5)


def test_wrapping():
    np.testing.assert_allclose(euler.wrapped(np.array([3.5, -3.5, 7.0, 0.1])),
                               [3.5 - 2 * np.pi, 2 * np.pi - 3.5, 7 - 2 * np.pi, 0.1])  # fmt: skip
    assert float(euler.wrapped_tensor(torch.tensor(3.5))) == pytest.approx(3.5 - 2 * np.pi)
