"""Say what observations mean for the filter's state: residual and Jacobian of each kind.

The error state is that of `motion_state.MotionState`; `T_body_sensor` takes points from the frame
that is observed to the filter's body frame. `axes` are the rows that count.
"""

from dataclasses import dataclass, field

import numpy as np

from cmrnet_ekf.ekf.motion_state import (
    GYROSCOPE,
    POSITION,
    ROTATION,
    SIZE,
    VELOCITY,
    MotionState,
)
from lcd_common import se3

_HERE = np.eye(4)
Axes = tuple[bool, ...]
ALL6: Axes = (True,) * 6
ALL3: Axes = (True,) * 3


@dataclass(frozen=True, slots=True)
class Innovation:
    """What an observation of m rows says of a state of n.

    Attributes:
        residual: observed minus expected [m].
        H: its derivative by the error state [m x n].
        covariance: of the observation [m x m].
    """

    residual: se3.Array
    H: se3.Array
    covariance: se3.Array

    def rows(self, axes: Axes) -> 'Innovation':
        """Return the rows that count."""
        if all(axes):
            return self
        keep = np.flatnonzero(axes)
        return Innovation(self.residual[keep], self.H[keep], self.covariance[np.ix_(keep, keep)])


@dataclass(frozen=True)
class PoseObservation:
    """A pose in the map, T_map_sensor, with its 6x6 covariance in the sensor's axes (se3).

    Axes are those of the map: x y z, and rotations about them.
    """

    stamp_ns: int
    source: str
    T_map_sensor: se3.Array
    covariance: se3.Array
    T_body_sensor: se3.Array = field(default_factory=lambda: _HERE)
    axes: Axes = ALL6
    correlation_s: float = 0.0

    @property
    def numbers(self) -> se3.Array:
        """What was observed."""
        return self.T_map_sensor

    def innovation(self, state: MotionState) -> Innovation:
        """Compare with a state."""
        R_sensor = state.R @ self.T_body_sensor[:3, :3]
        arm = self.T_body_sensor[:3, 3]
        T_map_expected = se3.from_rotation_translation(R_sensor, state.p + state.R @ arm)
        residual = np.empty(6)
        if all(self.axes):
            # In the coordinates of the filter's own error, in which however large a step is exact.
            xi = se3.log(se3.inverse(T_map_expected) @ self.T_map_sensor)
            residual[:3], residual[3:] = R_sensor @ xi[:3], R_sensor @ xi[3:]
        else:
            residual[:3] = self.T_map_sensor[:3, 3] - T_map_expected[:3, 3]
            residual[3:] = se3.so3_log(self.T_map_sensor[:3, :3] @ R_sensor.T)
        H = np.zeros((6, len(state.covariance)))
        H[:3, POSITION] = H[3:, ROTATION] = state.R
        H[:3, ROTATION] = -state.R @ se3.hat(arm)
        covariance = se3.ros_covariance(self.T_map_sensor, self.covariance)
        return Innovation(residual, H, covariance).rows(self.axes)


@dataclass(frozen=True)
class RelativeObservation:
    """A motion of the sensor between two stamps, T_from_to, covariance in the later's axes (se3).

    Axes are those of the sensor at the earlier stamp.
    """

    stamp_ns: int
    source: str
    from_ns: int
    T_from_to: se3.Array
    covariance: se3.Array
    T_body_sensor: se3.Array = field(default_factory=lambda: _HERE)
    axes: Axes = ALL6
    correlation_s: float = 0.0

    @property
    def numbers(self) -> se3.Array:
        """What was observed."""
        return self.T_from_to

    def innovation(self, state: MotionState) -> Innovation:
        """Compare with a state that carries the clone of the earlier pose."""
        index = self.clone_index(state)
        assert index is not None
        clone = state.clones[index]
        R_body, arm = self.T_body_sensor[:3, :3], self.T_body_sensor[:3, 3]
        R_from = clone.R @ R_body
        R_relative = R_from.T @ state.R @ R_body
        offset = state.p + state.R @ arm - clone.p - clone.R @ arm
        residual = np.empty(6)
        residual[:3] = self.T_from_to[:3, 3] - R_from.T @ offset
        residual[3:] = se3.so3_log(self.T_from_to[:3, :3] @ R_relative.T)
        H = np.zeros((6, len(state.covariance)))
        lever = se3.hat(arm)
        R_from_body = R_from.T @ state.R
        H[:3, POSITION] = H[3:, ROTATION] = R_from_body
        H[:3, ROTATION] = -R_from_body @ lever
        at = SIZE + 6 * index
        H[:3, at : at + 3] = H[3:, at + 3 : at + 6] = -R_body.T
        H[:3, at + 3 : at + 6] = R_body.T @ (lever + se3.hat(clone.R.T @ offset))
        covariance = se3.ros_covariance(self.T_from_to, self.covariance)
        return Innovation(residual, H, covariance).rows(self.axes)

    def clone_index(self, state: MotionState) -> int | None:
        """Return which clone of a state is the earlier pose, None when it has none."""
        for index, clone in enumerate(state.clones):
            if clone.stamp_ns == self.from_ns and clone.source == self.source:
                return index
        return None


@dataclass(frozen=True)
class TwistObservation:
    """A twist of the sensor in its own axes, linear first [6], with covariance 6x6 in these axes.

    The angular part observes the gyroscope bias: it counts only while an inertial sample holds, and
    that sample's noise is added to it (`gyroscope_noise` is its density, rad/s/sqrt(Hz)).
    """

    stamp_ns: int
    source: str
    twist: se3.Array
    covariance: se3.Array
    T_body_sensor: se3.Array = field(default_factory=lambda: _HERE)
    axes: Axes = ALL6
    correlation_s: float = 0.0
    gyroscope_noise: float = 0.0

    @property
    def numbers(self) -> se3.Array:
        """What was observed."""
        return self.twist

    def innovation(self, state: MotionState) -> Innovation:
        """Compare with a state."""
        R_body, arm = self.T_body_sensor[:3, :3], self.T_body_sensor[:3, 3]
        turning = state.turn_rate is not None
        w = np.zeros(3)
        if state.turn_rate is not None:
            w = state.turn_rate - state.gyroscope_bias
        v_body = state.R.T @ state.v
        expected = np.concatenate([R_body.T @ (v_body + np.cross(w, arm)), R_body.T @ w])
        H = np.zeros((6, len(state.covariance)))
        H[:3, VELOCITY] = R_body.T
        H[:3, ROTATION] = R_body.T @ se3.hat(v_body)
        if turning:
            H[:3, GYROSCOPE] = R_body.T @ se3.hat(arm)
            H[3:, GYROSCOPE] = -R_body.T
        covariance = self.covariance.copy()
        covariance[3:, 3:] += self.gyroscope_noise**2 * state.imu_hz * np.eye(3)
        axes = self.axes if turning else (*self.axes[:3], False, False, False)
        return Innovation(self.twist - expected, H, covariance).rows(axes)


@dataclass(frozen=True)
class PositionObservation:
    """A position in the map [3] of a point of the body [3], covariance 3x3 in map axes (GNSS)."""

    stamp_ns: int
    source: str
    position_map: se3.Array
    covariance: se3.Array
    position_body: se3.Array = field(default_factory=lambda: np.zeros(3))
    axes: Axes = ALL3
    correlation_s: float = 0.0

    @property
    def numbers(self) -> se3.Array:
        """What was observed."""
        return self.position_map

    def innovation(self, state: MotionState) -> Innovation:
        """Compare with a state."""
        H = np.zeros((3, len(state.covariance)))
        H[:, POSITION] = state.R
        H[:, ROTATION] = -state.R @ se3.hat(self.position_body)
        residual = self.position_map - (state.p + state.R @ self.position_body)
        return Innovation(residual, H, self.covariance).rows(self.axes)


Observation = PoseObservation | RelativeObservation | TwistObservation | PositionObservation
