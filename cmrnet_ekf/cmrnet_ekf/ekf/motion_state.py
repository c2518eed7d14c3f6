"""Hold the filter's state: a pose, a velocity and sensor biases, with what is uncertain of them."""

from dataclasses import dataclass, replace

import numpy as np

from lcd_common import se3

# Places in the error state [rho, phi, nu, gyroscope bias, accelerometer bias]; clones follow.
POSITION, ROTATION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
GYROSCOPE, ACCELEROMETER = slice(9, 12), slice(12, 15)
POSE = slice(0, 6)
SIZE = 15
# Odd, so that a median is one of them; long enough that a few lost samples do not move it.
_INTERVALS = 11
# Before two samples came, nothing tells how often they come.
_ASSUMED_HZ = 100.0


@dataclass(frozen=True, slots=True)
class Clone:
    """A pose of the past that a relative observation refers to."""

    stamp_ns: int
    source: str
    R: se3.Array
    p: se3.Array


@dataclass(frozen=True, slots=True)
class Memory:
    """What the filter remembers of an input between its observations.

    Attributes:
        stamp_ns: of the last observation, accepted or not.
        accepted_ns: of the last accepted one, None before any.
        absolute: whether it says where the vehicle is in the map.
        rejected: rejections in a row that agree with each other.
        residual: of the last observation, when it was rejected.
        covariance: of the last observation itself, when it was rejected.
    """

    stamp_ns: int
    accepted_ns: int | None = None
    absolute: bool = False
    rejected: int = 0
    residual: se3.Array | None = None
    covariance: se3.Array | None = None


@dataclass(frozen=True, slots=True)
class MotionState:
    """Estimate at one time; arrays are never changed once they are in here.

    The error is one of the group of poses and velocities, in body axes (left-invariant):
    `p_true = p + R J(phi) rho`, `R_true = R exp(phi)`, `v_true = v + R J(phi) nu`, so that the
    first six are `lcd_common.se3`'s perturbation of T_map_body. Barrau and Bonnabel, The Invariant
    Extended Kalman Filter as a Stable Observer, 2017.

    Attributes:
        stamp_ns: time.
        R, p, v: R_map_body [3 x 3], position and velocity in map axes [3], m and m/s.
        gyroscope_bias, accelerometer_bias: [3], rad/s and m/s^2, in the sensor's axes (the body's).
        covariance: of the error, [15 + 6 clones] squared.
        turn_rate, force: the inertial sample that holds now [3], None when there is none.
        imu_ns: stamp of that sample.
        doubtful: whether that sample is a guess (a frozen sensor): its noise is that of coasting.
        clones: past poses, in the order of their rows.
        memory: what to remember of each input, by name.
        intervals_ns: times between the last inertial samples, without those across gaps.
    """

    stamp_ns: int
    R: se3.Array
    p: se3.Array
    v: se3.Array
    gyroscope_bias: se3.Array
    accelerometer_bias: se3.Array
    covariance: se3.Array
    turn_rate: se3.Array | None = None
    force: se3.Array | None = None
    imu_ns: int = 0
    doubtful: bool = False
    clones: tuple[Clone, ...] = ()
    memory: tuple[tuple[str, Memory], ...] = ()
    intervals_ns: tuple[int, ...] = ()

    @property
    def T_map_body(self) -> se3.Array:
        """Pose as 4x4 transform."""
        return se3.from_rotation_translation(self.R, self.p)

    @property
    def imu_hz(self) -> float:
        """Return how many inertial samples come in a second, by the median of their intervals."""
        if not self.intervals_ns:
            return _ASSUMED_HZ
        return 1e9 / sorted(self.intervals_ns)[len(self.intervals_ns) // 2]

    def intervals_until(self, stamp_ns: int, longest_ns: int) -> tuple[int, ...]:
        """Return the intervals with that to a new sample, unless it is a gap or the first."""
        interval_ns = stamp_ns - self.imu_ns
        if self.turn_rate is None or not 0 < interval_ns <= longest_ns:
            return self.intervals_ns
        return (*self.intervals_ns[1 - _INTERVALS :], interval_ns)

    def remembered(self, source: str) -> Memory | None:
        """Return what is remembered of an input, None before its first observation."""
        return next((memory for name, memory in self.memory if name == source), None)

    def remembering(self, source: str, memory: Memory) -> 'MotionState':
        """Return the state with another memory of an input."""
        others = tuple(pair for pair in self.memory if pair[0] != source)
        return replace(self, memory=(*others, (source, memory)))


def corrected(state: MotionState, error: se3.Array, covariance: se3.Array) -> MotionState:
    """Move a state, and its clones, by an error vector [n]; `covariance` becomes its own.

    The covariance is not transported to the new tangent space: that is a term of third order which
    EKFs leave out.
    """
    step = se3.exp(error[POSE])
    # The same integral as the position's: exp's translation with nu in place of rho.
    nu = se3.exp(np.concatenate([error[VELOCITY], error[ROTATION]]))[:3, 3]
    clones = tuple(
        _moved(clone, error[SIZE + 6 * i : SIZE + 6 * i + 6])
        for i, clone in enumerate(state.clones)
    )
    return replace(
        state,
        R=_orthonormal(state.R @ step[:3, :3]),
        p=state.p + state.R @ step[:3, 3],
        v=state.v + state.R @ nu,
        gyroscope_bias=state.gyroscope_bias + error[GYROSCOPE],
        accelerometer_bias=state.accelerometer_bias + error[ACCELEROMETER],
        covariance=covariance,
        clones=clones,
    )


def cloned(state: MotionState, source: str) -> MotionState:
    """Return the state with its pose kept as a further clone, fully correlated with it."""
    n = len(state.covariance)
    P = np.empty((n + 6, n + 6))
    P[:n, :n] = state.covariance
    P[n:, :n] = state.covariance[POSE]
    P[:n, n:] = state.covariance[:, POSE]
    P[n:, n:] = state.covariance[POSE, POSE]
    clone = Clone(state.stamp_ns, source, state.R, state.p)
    return replace(state, covariance=P, clones=(*state.clones, clone))


def without_clone(state: MotionState, index: int) -> MotionState:
    """Return the state with a clone marginalised: its rows are dropped."""
    begin = SIZE + 6 * index
    keep = np.r_[0:begin, begin + 6 : len(state.covariance)]
    return replace(
        state,
        covariance=state.covariance[np.ix_(keep, keep)],
        clones=state.clones[:index] + state.clones[index + 1 :],
    )


def _moved(clone: Clone, xi: se3.Array) -> Clone:
    step = se3.exp(xi)
    return replace(clone, R=clone.R @ step[:3, :3], p=clone.p + clone.R @ step[:3, 3])


def _orthonormal(R: se3.Array) -> se3.Array:
    """Return R with its rounding errors taken off: one step of Newton's polar decomposition."""
    return R @ (1.5 * np.eye(3) - 0.5 * (R.T @ R))
