"""States, small errors between them and a rough drive, for the filter's tests."""

from dataclasses import dataclass, replace

import numpy as np

from cmrnet_ekf.ekf.motion_state import SIZE, MotionState, corrected
from lcd_common import se3


def random_state(rng: np.random.Generator, stamp_ns: int = 0) -> MotionState:
    """Return a state anywhere, turning and accelerating, with some covariance."""
    root = rng.normal(size=(SIZE, SIZE)) * 0.1
    return MotionState(
        stamp_ns,
        se3.so3_exp(rng.normal(size=3)),
        rng.normal(size=3) * 10.0,
        rng.normal(size=3) * 5.0,
        rng.normal(size=3) * 0.02,
        rng.normal(size=3) * 0.1,
        root @ root.T + 1e-3 * np.eye(SIZE),
        rng.normal(size=3) * 0.5,
        rng.normal(size=3) * 2.0 + [0.0, 0.0, 9.81],
        stamp_ns,
    )


def moved(state: MotionState, error: se3.Array) -> MotionState:
    """Return the state that is an error away."""
    return corrected(state, error, state.covariance)


def error_between(true: MotionState, state: MotionState) -> se3.Array:
    """Return the error [15] of a state, written down independently of `corrected`."""
    xi = se3.log(se3.inverse(state.T_map_body) @ true.T_map_body)
    # The left Jacobian, column by column.
    columns = [se3.exp(np.concatenate([axis, xi[3:]]))[:3, 3] for axis in np.eye(3)]
    nu = np.linalg.solve(np.array(columns).T, state.R.T @ (true.v - state.v))
    return np.concatenate(
        [
            xi,
            nu,
            true.gyroscope_bias - state.gyroscope_bias,
            true.accelerometer_bias - state.accelerometer_bias,
        ]
    )


@dataclass(frozen=True)
class Drive:
    """What a vehicle truly did, and what its perfect sensor would have said."""

    stamps_ns: np.ndarray
    turn_rates: np.ndarray
    forces: np.ndarray
    T_map_body: np.ndarray
    velocities: np.ndarray


def drive(seconds: float, rate_hz: float = 100.0, gravity: float = 9.81) -> Drive:
    """Make a drive of constant rates between samples: each sample is the truth until the next."""
    dt, n = 1.0 / rate_hz, round(seconds * rate_hz)
    t = np.arange(n + 1) * dt
    turn = np.stack([0.02 * np.sin(t), 0.03 * np.cos(0.7 * t), 0.3 * np.sin(0.4 * t)], axis=1)
    along = np.stack([np.cos(0.5 * t), 0.1 * np.sin(2 * t), 0.05 * np.sin(3 * t)], axis=1)
    R, p, v = np.eye(3), np.zeros(3), np.array([8.0, 0.0, 0.0])
    g = np.array([0.0, 0.0, -gravity])
    forces, poses, velocities = [], [], []
    fine = 5
    for k in range(n + 1):
        poses.append(se3.from_rotation_translation(R, p))
        velocities.append(v)
        # Level gravity out and steer so that the vehicle mostly follows its nose.
        force = along[k] + R.T @ -g + np.cross(turn[k], R.T @ v)
        forces.append(force)
        for _ in range(fine):  # the truth between samples: a fine Runge-Kutta free integration
            h = dt / fine
            middle = R @ se3.so3_exp(turn[k] * h / 2)
            a = middle @ force + g
            p, v = p + v * h + 0.5 * a * h * h, v + a * h
            R = R @ se3.so3_exp(turn[k] * h)
    return Drive(
        np.round(t * 1e9).astype(np.int64),
        turn,
        np.array(forces),
        np.array(poses),
        np.array(velocities),
    )


def without_noise(state: MotionState) -> MotionState:
    """Return the state with no covariance at all."""
    return replace(state, covariance=np.zeros_like(state.covariance))
