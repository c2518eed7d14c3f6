"""Keep an estimate up to date while factors come and go: GTSAM's iSAM2 with poses as arrays."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_loop_closure.weighted_graph import poses_of, relative_covariance

# So few poses are fetched one by one.
_FEW = 500
# A pose is only computed anew once its delta moved by this (rad, m): less than wildfire leaves out.
_UNREAD = np.repeat([1e-5, 1e-4], 3)


@config
class IncrementalConfig:
    """How eagerly iSAM2 works."""

    relinearize_translation: float = setting(
        0.5, 'a pose that moved farther is linearized anew', unit='m', low=1e-6
    )
    relinearize_rotation: float = setting(
        0.05, 'a pose that turned farther is linearized anew', unit='rad', low=1e-6
    )
    wildfire: float = setting(
        3e-3, 'changes smaller than this (m, rad) are not carried further', low=0.0
    )


class IncrementalSolver:
    """Estimate poses, and velocities and biases where there are any, by iSAM2.

    Poses have the keys X(row). A factor gets a handle when it is added, by which it is removed.
    """

    def __init__(self, settings: IncrementalConfig, *, careful: bool = False) -> None:
        """Start empty; `careful` factorizes by QR, half as fast and never ill-conditioned."""
        turn, move = settings.relinearize_rotation, settings.relinearize_translation
        self._thresholds = np.repeat([turn, move], 3)
        thresholds = gtsam.ISAM2ThresholdMap()
        thresholds.insert(('x', self._thresholds))
        thresholds.insert(('v', np.full(3, move)))
        thresholds.insert(('b', np.full(6, turn)))
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(thresholds)
        params.setFactorization('QR' if careful else 'CHOLESKY')
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        params.setOptimizationParams(gtsam.ISAM2GaussNewtonParams(settings.wildfire))
        self._isam = gtsam.ISAM2(params)
        self._new_factors = gtsam.NonlinearFactorGraph()
        self._new_values = gtsam.Values()
        self._new_handles: list[int] = []
        self._new_rows = 0
        self._removed: list[int] = []
        self._slots: dict[int, int] = {}
        self._next_handle = 0
        self._keys: list[int] = []
        self._stale = 0  # updates since the poses were read
        self._delta = np.zeros((0, 6))
        self._read_delta = np.zeros((0, 6))
        self._linearized = np.zeros((0, 4, 4))
        self._poses = np.zeros((0, 4, 4))

    def __len__(self) -> int:
        """Count the poses that updates have taken in."""
        return len(self._keys)

    @property
    def poses(self) -> se3.Array:
        """Estimated poses [N x 4 x 4] after the last update; not to be written to."""
        if self._stale:
            self._read_poses()
        return self._poses

    @property
    def poses_read(self) -> se3.Array:
        """Poses [M x 4 x 4] as they were last asked for; not to be written to."""
        return self._poses

    def pose(self, row: int) -> se3.Array:
        """Return one estimated pose after the last update."""
        T: se3.Array = self._isam.calculateEstimatePose3(self._keys[row]).matrix()
        return T

    def bias(self, row: int) -> gtsam.imuBias.ConstantBias:
        """Return the estimated IMU bias of a row that has one."""
        return self._isam.calculateEstimateConstantBias(B(row))

    def add_pose(self, T: se3.Array) -> int:
        """Append a pose with its first estimate; return its row."""
        row = len(self._keys) + self._new_rows
        self._new_values.insert(X(row), gtsam.Pose3(T))
        self._new_rows += 1
        return row

    def add_velocity(self, row: int, velocity: NDArray[np.float64]) -> None:
        """Give a row a velocity (map axes, m/s) and an IMU bias (zero at first)."""
        self._new_values.insert(V(row), velocity)
        self._new_values.insert(B(row), gtsam.imuBias.ConstantBias())

    def add(self, factor: gtsam.NonlinearFactor) -> int:
        """Add a factor at the next update; return its handle."""
        self._new_factors.add(factor)
        self._new_handles.append(self._next_handle)
        self._next_handle += 1
        return self._next_handle - 1

    def remove(self, handle: int) -> None:
        """Take a factor out at the next update."""
        self._removed.append(self._slots.pop(handle))

    def update(self) -> None:
        """Take in what was added and removed, one Gauss-Newton step of what it touches."""
        result = self._isam.update(self._new_factors, self._new_values, self._removed)
        self._slots.update(zip(self._new_handles, result.getNewFactorsIndices(), strict=True))
        self._keys.extend(
            X(row) for row in range(len(self._keys), len(self._keys) + self._new_rows)
        )
        self._new_factors = gtsam.NonlinearFactorGraph()
        self._new_values = gtsam.Values()
        self._new_handles = []
        self._removed = []
        self._new_rows = 0
        self._stale += 1

    def _read_poses(self) -> None:
        """Bring the array of poses up to date, touching only what changed.

        A pose is its linearization point moved by a delta. The point changes in an update only
        where the delta had passed the threshold; after two updates the first delta is not known.
        """
        delta = self._isam.getDelta().vector(self._keys).reshape(-1, 6)
        known = len(self._delta)
        anew = np.ones(len(delta), bool)
        if self._stale == 1:
            anew[:known] = (np.abs(self._delta) >= self._thresholds).any(axis=1)
        values = self._isam.getLinearizationPoint()
        if anew.sum() < _FEW:
            linearized = np.empty((len(delta), 4, 4))
            linearized[:known] = self._linearized
            for row in np.nonzero(anew)[0].tolist():
                linearized[row] = values.atPose3(self._keys[row]).matrix()
        else:
            linearized = poses_of(values)
        changed = anew
        moved = np.abs(delta[:known] - self._read_delta) > _UNREAD
        changed[:known] |= moved.any(axis=1)
        read_delta = delta.copy()
        read_delta[~changed] = self._read_delta[~changed[:known]]
        poses = np.empty_like(linearized)
        poses[:known] = self._poses
        rows = np.nonzero(changed)[0]
        # In pieces that stay in the processor's cache.
        for some in np.array_split(rows, len(rows) // 1000 + 1):
            poses[some] = _retract(linearized[some], delta[some])
        self._linearized, self._poses, self._delta, self._stale = linearized, poses, delta, 0
        self._read_delta = read_delta

    def pose_covariance(self, row: int) -> se3.Array:
        """Return the marginal 6x6 of a pose, body axes, translation first."""
        return se3.covariance_from_gtsam(self._isam.marginalCovariance(X(row)))

    def relative_covariance(self, first: int, second: int) -> se3.Array:
        """Return the 6x6 of T_first_second, body axes of the second, translation first."""
        joint = self._isam.jointMarginalCovariance([X(first), X(second)])
        return relative_covariance(self.pose(first), self.pose(second), joint, X(first), X(second))


def _retract(T: se3.Array, delta_rotation_first: NDArray[np.float64]) -> se3.Array:
    """Return T * exp(delta) of each row; delta [N x 6] in GTSAM's order."""
    phi, rho = delta_rotation_first[:, :3], delta_rotation_first[:, 3:]
    squared = np.einsum('ij,ij->i', phi, phi)
    small = squared < 1e-10
    square = np.where(small, 1.0, squared)
    angle = np.sqrt(square)
    a = np.where(small, 1.0, np.sin(angle) / angle)
    b = np.where(small, 0.5, (1.0 - np.cos(angle)) / square)
    c = np.where(small, 1.0 / 6.0, (1.0 - a) / square)
    K = np.zeros((len(T), 3, 3))
    K[:, 2, 1], K[:, 0, 2], K[:, 1, 0] = phi.T
    K[:, 1, 2], K[:, 2, 0], K[:, 0, 1] = -phi.T
    K_K = K @ K
    exp = np.zeros_like(T)
    exp[:, :3, :3] = np.eye(3) + a[:, None, None] * K + b[:, None, None] * K_K
    V = np.eye(3) + b[:, None, None] * K + c[:, None, None] * K_K
    exp[:, :3, 3] = np.einsum('nij,nj->ni', V, rho)
    exp[:, 3, 3] = 1.0
    return T @ exp
