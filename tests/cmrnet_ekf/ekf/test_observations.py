"""Residuals and Jacobians of every observation, by finite differences and by exact cases."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from moving_states import moved, random_state

from cmrnet_ekf.ekf.motion_state import MotionState, cloned
from cmrnet_ekf.ekf.observations import (
    Observation,
    PoseObservation,
    PositionObservation,
    RelativeObservation,
    TwistObservation,
)
from lcd_common import se3

Maker = Callable[[MotionState, np.random.Generator], Observation]


def _mounting(rng: np.random.Generator) -> se3.Array:
    return se3.exp(rng.normal(size=6) * [1, 1, 1, 0.5, 0.5, 0.5])


def _pose(state: MotionState, rng: np.random.Generator) -> Observation:
    T_body_sensor = _mounting(rng)
    return PoseObservation(0, 'camera', state.T_map_body @ T_body_sensor, np.eye(6), T_body_sensor)


def _relative(state: MotionState, rng: np.random.Generator) -> Observation:
    T_body_sensor, clone = _mounting(rng), state.clones[0]
    T_from = se3.from_rotation_translation(clone.R, clone.p) @ T_body_sensor
    motion = se3.inverse(T_from) @ state.T_map_body @ T_body_sensor
    return RelativeObservation(state.stamp_ns, 'odom', -1, motion, np.eye(6), T_body_sensor)


def _twist(state: MotionState, rng: np.random.Generator) -> Observation:
    T_body_sensor = _mounting(rng)
    assert state.turn_rate is not None
    w = state.turn_rate - state.gyroscope_bias
    # The twist of the sensor frame is the adjoint's image of the body's.
    twist = se3.adjoint(se3.inverse(T_body_sensor)) @ np.concatenate([state.R.T @ state.v, w])
    return TwistObservation(0, 'wheels', twist, np.eye(6), T_body_sensor)


def _position(state: MotionState, rng: np.random.Generator) -> Observation:
    antenna = rng.normal(size=3)
    return PositionObservation(0, 'gps', state.p + state.R @ antenna, np.eye(3), antenna)


@pytest.mark.parametrize('make', [_pose, _relative, _twist, _position])
@pytest.mark.parametrize('seed', range(3))
def test_the_jacobian_is_the_derivative(make: Maker, seed: int) -> None:
    rng = np.random.default_rng(seed)
    before = random_state(rng, stamp_ns=-1)
    state = replace(random_state(rng), clones=cloned(before, 'odom').clones)
    root = rng.normal(size=(21, 21))
    state = replace(state, covariance=root @ root.T)
    seen = make(state, rng)
    innovation = seen.innovation(state)
    np.testing.assert_allclose(innovation.residual, 0.0, atol=1e-12)
    h = 1e-6
    numeric = np.empty_like(innovation.H)
    for i in range(numeric.shape[1]):
        step = np.zeros(numeric.shape[1])
        step[i] = h
        ahead = seen.innovation(moved(state, step)).residual
        behind = seen.innovation(moved(state, -step)).residual
        # The residual is observed minus expected: it falls where the expectation rises.
        numeric[:, i] = -(ahead - behind) / (2 * h)
    np.testing.assert_allclose(innovation.H, numeric, atol=1e-7)


def test_masked_axes_are_those_of_the_map() -> None:
    rng = np.random.default_rng(0)
    state = random_state(rng)
    off = state.T_map_body.copy()
    off[:3, 3] += [1.0, 2.0, 3.0]
    seen = PoseObservation(
        0, 'camera', off, np.eye(6), axes=(True, False, True, False, False, False)
    )
    innovation = seen.innovation(state)
    np.testing.assert_allclose(innovation.residual, [1.0, 3.0], atol=1e-12)
    assert innovation.H.shape == (2, 15) and innovation.covariance.shape == (2, 2)


def test_the_covariance_is_turned_into_the_axes_of_the_residual() -> None:
    """A camera sure along its own z axis is sure along that direction of the map."""
    state = random_state(np.random.default_rng(1))
    sure = np.diag([1.0, 1.0, 1e-6, 1.0, 1.0, 1.0])
    seen = PoseObservation(0, 'camera', state.T_map_body, sure)
    covariance = seen.innovation(state).covariance[:3, :3]
    values, vectors = np.linalg.eigh(covariance)
    assert values[0] == pytest.approx(1e-6)
    assert abs(vectors[:, 0] @ state.R[:, 2]) == pytest.approx(1.0)


def test_without_an_inertial_sample_a_twist_says_nothing_of_the_turn() -> None:
    rng = np.random.default_rng(2)
    state = random_state(rng)
    seen = _twist(state, rng)
    coasting = replace(state, turn_rate=None, force=None)
    assert len(seen.innovation(state).residual) == 6
    assert len(seen.innovation(coasting).residual) == 3
