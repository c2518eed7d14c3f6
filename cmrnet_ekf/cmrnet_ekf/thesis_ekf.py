"""Track a vehicle as the thesis does: a velocity motion model, corrected by CMRNet's pose.

Thesis section 5.2.3, Algorithm 2. Its letters are those of Thrun's Probabilistic Robotics: R there
is the covariance of the motion (Q in filterpy), Q there that of the measurement (R in filterpy).
"""

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.settings import config, setting

# Below this turn in a step (33) divides by almost nothing; the series is exact to rounding.
_STRAIGHT_RAD = 1e-4


@config
class ThesisEkfConfig:
    """The thesis's preset; variances, the motion's for each step."""

    start_translation: float = setting(0.5, 'variance of x y z at the start', unit='m^2', low=0.0)
    start_rotation: float = setting(
        0.125, 'variance of roll pitch yaw at the start', unit='rad^2', low=0.0
    )
    motion_translation: float = setting(
        0.5, 'variance that a step of the motion adds to x y z', unit='m^2', low=0.0
    )
    motion_rotation: float = setting(
        0.0625, 'variance that a step of the motion adds to roll pitch yaw', unit='rad^2', low=0.0
    )


class ThesisEkf:
    """State x y z roll pitch yaw; z, roll and pitch are moved by measurements alone.

    Args:
        settings: variances.
        T_map_base: pose at the start.
    """

    def __init__(self, settings: ThesisEkfConfig, T_map_base: se3.Array) -> None:
        self._filter = ExtendedKalmanFilter(dim_x=6, dim_z=6)
        self._filter.x = pose_vector(T_map_base)
        self._filter.P = _diagonal(settings.start_translation, settings.start_rotation)
        self._filter.Q = _diagonal(settings.motion_translation, settings.motion_rotation)
        self._filter.B = 0

    @property
    def T_map_base(self) -> se3.Array:
        """Pose."""
        return pose_matrix(self._filter.x)

    @property
    def covariance(self) -> se3.Array:
        """Covariance 6x6 of x y z roll pitch yaw (not of a twist)."""
        return np.array(self._filter.P)

    def predict(self, speed_mps: float, turn_rate_radps: float, dt_s: float) -> None:
        """Move along an arc, equation (33); every call is one step of the motion's noise."""
        values = (speed_mps, turn_rate_radps, dt_s)
        if not np.isfinite(values).all() or dt_s < 0.0:
            raise DataError(f'expected finite speed and turn rate and a time, got {values}')
        state = self._filter.x
        G = motion_jacobian(state, *values)
        self._filter.x = wrapped(motion(state, *values))
        self._filter.P = G @ self._filter.P @ G.T + self._filter.Q

    def update(self, T_map_base: se3.Array, covariance: se3.Array) -> None:
        """Correct by a measured pose; covariance 6x6 of x y z roll pitch yaw, the thesis's Q."""
        if not np.isfinite(T_map_base).all() or not se3.is_covariance(covariance):
            raise DataError('expected a finite pose and a positive definite 6 x 6 covariance')
        self._filter.update(
            pose_vector(T_map_base),
            HJacobian=lambda _: np.eye(6),
            Hx=lambda state: state,
            R=covariance,
            residual=lambda measured, expected: wrapped(measured - expected),
        )
        self._filter.x = wrapped(self._filter.x)


def motion(state: se3.Array, speed_mps: float, turn_rate_radps: float, dt_s: float) -> se3.Array:
    """Return the state [6] after an arc, equation (33), and its limit on the straight."""
    yaw, turn, way = state[5], turn_rate_radps * dt_s, speed_mps * dt_s
    half = yaw + 0.5 * turn
    # (33) by half angles: v/w (sin(yaw + w dt) - sin yaw) = v dt cos(half) sinc(w dt / 2).
    chord = way * _sinc(0.5 * turn)
    return state + np.array([chord * np.cos(half), chord * np.sin(half), 0.0, 0.0, 0.0, turn])


def motion_jacobian(
    state: se3.Array, speed_mps: float, turn_rate_radps: float, dt_s: float
) -> se3.Array:
    """Return the derivative [6 x 6] of `motion` by the state (the thesis's G)."""
    turn = turn_rate_radps * dt_s
    half, chord = state[5] + 0.5 * turn, speed_mps * dt_s * _sinc(0.5 * turn)
    G = np.eye(6)
    G[0, 5], G[1, 5] = -chord * np.sin(half), chord * np.cos(half)
    return G


def pose_vector(T: se3.Array) -> se3.Array:
    """Return x y z roll pitch yaw of a transform, R = Rz(yaw) Ry(pitch) Rx(roll)."""
    pitch = np.arctan2(-T[2, 0], np.hypot(T[0, 0], T[1, 0]))
    angles = [np.arctan2(T[2, 1], T[2, 2]), pitch, np.arctan2(T[1, 0], T[0, 0])]
    return np.concatenate([T[:3, 3], angles])


def pose_matrix(vector: se3.Array) -> se3.Array:
    """Return the 4x4 transform of x y z roll pitch yaw."""
    roll, pitch, yaw = vector[3:]
    R = se3.so3_exp([0, 0, yaw]) @ se3.so3_exp([0, pitch, 0]) @ se3.so3_exp([roll, 0, 0])
    return se3.from_rotation_translation(R, vector[:3])


def wrapped(vector: se3.Array) -> se3.Array:
    """Return a state or a difference of states with its angles within -pi .. pi."""
    out = np.array(vector)
    out[3:] = np.arctan2(np.sin(out[3:]), np.cos(out[3:]))
    return out


def _sinc(angle: float) -> float:
    if abs(angle) < _STRAIGHT_RAD:
        return 1.0 - angle * angle / 6.0
    return float(np.sin(angle) / angle)


def _diagonal(translation: float, rotation: float) -> se3.Array:
    return np.diag([translation] * 3 + [rotation] * 3)
