"""Move the filter's state through time by inertial samples, or coast where there are none."""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cmrnet_ekf.ekf.ekf_settings import MotionConfig
from cmrnet_ekf.ekf.motion_state import (
    POSITION,
    SIZE,
    VELOCITY,
    MotionState,
)
from lcd_common import se3

_EYE = np.eye(3)
_DIAGONAL = np.arange(SIZE)


class Propagation:
    """Propagate states; a sample holds from its stamp to the next one.

    The error of a left-invariant filter moves by a matrix of the measurements alone, apart from
    the biases (Barrau and Bonnabel 2017, theorem 1); noise densities are scaled with time.
    """

    def __init__(self, settings: MotionConfig) -> None:
        self.settings = settings
        self._hold_ns = round(settings.imu_hold * 1e9)
        self._gravity = np.array([0.0, 0.0, -settings.gravity])
        # Filled anew at every step: what is not filled stays as it is here.
        self._F = np.eye(SIZE)
        self._left = np.empty((SIZE, SIZE))
        self._places: dict[int, NDArray[np.intp]] = {}

    def to(self, state: MotionState, stamp_ns: int) -> MotionState:
        """Return the state at a later stamp (or the state itself at its own)."""
        if stamp_ns <= state.stamp_ns:
            return state
        held_ns = min(stamp_ns, state.imu_ns + self._hold_ns)
        if state.turn_rate is not None and held_ns > state.stamp_ns:
            state = self._by_sample(state, held_ns)
        if stamp_ns > state.stamp_ns:
            state = self._coast(state, stamp_ns)
        return state

    def _by_sample(self, state: MotionState, stamp_ns: int) -> MotionState:
        assert state.turn_rate is not None and state.force is not None
        dt = (stamp_ns - state.stamp_ns) * 1e-9
        # Scalars and dot(): a third of the time that operators on such small arrays take.
        turn = (state.turn_rate - state.gyroscope_bias).tolist()
        force = (state.force - state.accelerometer_bias).tolist()
        D = _rotation(turn, dt)
        gained_v, gained_p = _gained(turn, force, dt)
        v_and_p = state.R.dot(np.array((gained_v, gained_p)).T)
        F = self._F
        Dt = D.T
        B = Dt.dot(_hat(force, dt))
        F[0:3, 0:3] = F[3:6, 3:6] = F[6:9, 6:9] = Dt
        F[0:3, 6:9] = dt * Dt
        F[0:3, 3:6] = Dt.dot(_hat(gained_p, -1.0))
        F[6:9, 3:6] = Dt.dot(_hat(gained_v, -1.0))
        if self.settings.estimate_biases:
            F[3:6, 9:12] = J = _bias_turn(turn, dt)
            F[6:9, 9:12] = (0.5 * dt) * B
            F[0:3, 9:12] = (dt * dt / 6.0) * B
            F[6:9, 12:15] = C = Dt.dot(J.T)
            F[0:3, 12:15] = (0.5 * dt) * C
        P = self._moved(state.covariance)
        s = self.settings
        if state.doubtful:
            self._add_noise(P, dt, s.coast_acceleration**2, s.coast_turn**2)
        else:
            self._add_noise(P, dt, s.accelerometer_noise**2, s.gyroscope_noise**2)
        v = state.v + dt * self._gravity
        return MotionState(
            stamp_ns,
            state.R.dot(D),
            state.p + (0.5 * dt) * (state.v + v) + v_and_p[:, 1],
            v + v_and_p[:, 0],
            state.gyroscope_bias,
            state.accelerometer_bias,
            P,
            state.turn_rate,
            state.force,
            state.imu_ns,
            state.doubtful,
            state.clones,
            state.memory,
            state.intervals_ns,
        )

    def _coast(self, state: MotionState, stamp_ns: int) -> MotionState:
        """Keep velocity and rotation, which become uncertain fast."""
        dt = (stamp_ns - state.stamp_ns) * 1e-9
        F = self._F
        F[0:9, 0:15] = 0.0
        F[_DIAGONAL[:9], _DIAGONAL[:9]] = 1.0
        F[POSITION, VELOCITY] = dt * _EYE
        P = self._moved(state.covariance)
        s = self.settings
        self._add_noise(P, dt, s.coast_acceleration**2, s.coast_turn**2)
        return replace(
            state,
            stamp_ns=stamp_ns,
            p=state.p + dt * state.v,
            covariance=P,
            turn_rate=None,
            force=None,
        )

    def _moved(self, P: se3.Array) -> se3.Array:
        F = self._F
        if len(P) == SIZE:
            return F.dot(P, out=self._left).dot(F.T)
        out = P.copy()
        out[:SIZE, SIZE:] = F @ P[:SIZE, SIZE:]
        out[SIZE:, :SIZE] = out[:SIZE, SIZE:].T
        out[:SIZE, :SIZE] = F @ P[:SIZE, :SIZE] @ F.T
        return out

    def _add_noise(self, P: se3.Array, dt: float, q_velocity: float, q_rotation: float) -> None:
        """Add what white noise does in dt; the same in all axes, so rotations do not touch it."""
        s, cubed, cross = self.settings, q_velocity * dt**3 / 3.0, q_velocity * dt * dt / 2.0
        turn, speed = q_rotation * dt, q_velocity * dt
        gyroscope = accelerometer = 0.0
        if s.estimate_biases:
            gyroscope, accelerometer = s.gyroscope_walk**2 * dt, s.accelerometer_walk**2 * dt
        added = (cubed, turn, speed, gyroscope, accelerometer, cross, cross)
        P.reshape(-1)[self._noisy(len(P))] += np.array(added).repeat(3)

    def _noisy(self, n: int) -> NDArray[np.intp]:
        """Return where noise comes in, in a covariance [n x n] laid flat."""
        if n not in self._places:
            rows = np.r_[0:15, 0:3, 6:9]
            columns = np.r_[0:15, 6:9, 0:3]
            self._places[n] = rows * n + columns
        return self._places[n]


def _hat(v: list[float], scale: float) -> se3.Array:
    x, y, z = v[0] * scale, v[1] * scale, v[2] * scale
    return np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0)))


def _rotation(turn: list[float], dt: float) -> se3.Array:
    """Return exp of the rotation vector turn * dt."""
    x, y, z = turn[0] * dt, turn[1] * dt, turn[2] * dt
    square = x * x + y * y + z * z
    if square < 1e-10:  # the series is exact to double precision here
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        angle = math.sqrt(square)
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    return np.array(
        (
            (1.0 - b * (y * y + z * z), b * x * y - a * z, b * x * z + a * y),
            (b * x * y + a * z, 1.0 - b * (x * x + z * z), b * y * z - a * x),
            (b * x * z - a * y, b * y * z + a * x, 1.0 - b * (x * x + y * y)),
        )
    )


def _gained(turn: list[float], force: list[float], dt: float) -> tuple[list[float], list[float]]:
    """Return velocity [3] and way [3] that a sample adds, in the axes at its start.

    Exact but for (turn rate dt)^2.
    """
    x, y, z = turn
    fx, fy, fz = force
    cx, cy, cz = y * fz - z * fy, z * fx - x * fz, x * fy - y * fx
    h, q, t = 0.5 * dt * dt, dt**3 / 6.0, dt
    velocity = [t * fx + h * cx, t * fy + h * cy, t * fz + h * cz]
    way = [h * fx + q * cx, h * fy + q * cy, h * fz + q * cz]
    return velocity, way


def _bias_turn(turn: list[float], dt: float) -> se3.Array:
    """Return how the gyroscope's bias turns the body: -dt times the right Jacobian."""
    h = 0.5 * dt * dt
    x, y, z = turn[0] * h, turn[1] * h, turn[2] * h
    return np.array(((-dt, -z, y), (z, -dt, -x), (-y, x, -dt)))
