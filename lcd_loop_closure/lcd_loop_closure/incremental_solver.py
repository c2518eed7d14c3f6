"""Keep an estimate up to date while factors come and go: GTSAM's iSAM2 with poses as arrays."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_loop_closure.weighted_graph import poses_of, relative_covariance

# So few poses are fetched one by one.
_FEW = 500


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
        1e-3, 'changes smaller than this (m, rad) are not carried further', low=0.0
    )


class IncrementalSolver:
    """Estimate poses, and velocities and biases where there are any, by iSAM2.

    Poses have the keys X(row). A factor gets a handle when it is added, by which it is removed.
    """

    def __init__(self, settings: IncrementalConfig) -> None:
        turn, move = settings.relinearize_rotation, settings.relinearize_translation
        self._thresholds = np.repeat([turn, move], 3)
        thresholds = gtsam.ISAM2ThresholdMap()
        thresholds.insert(('x', self._thresholds))
        thresholds.insert(('v', np.full(3, move)))
        thresholds.insert(('b', np.full(6, turn)))
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(thresholds)
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
        self._delta = np.zeros((0, 6))
        self._linearized = np.zeros((0, 4, 4))
        self._poses = np.zeros((0, 4, 4))

    @property
    def poses(self) -> se3.Array:
        """Estimated poses [N x 4 x 4] after the last update; not to be written to."""
        return self._poses

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
        self._read_poses()

    def _read_poses(self) -> None:
        """Bring the array of poses up to date, touching only what changed.

        GTSAM's own ways to all estimates take 10 ms and more for ten thousand poses. A pose is its
        linearization point moved by a delta; the former changes only where the delta had passed the
        threshold, which is gtsam's rule too.
        """
        delta = self._isam.getDelta().vector(self._keys).reshape(-1, 6)
        known = len(self._delta)
        anew = (np.abs(self._delta) >= self._thresholds).any(axis=1)
        if anew.any() or known < len(delta):
            values = self._isam.getLinearizationPoint()
            if anew.sum() + len(delta) - known < _FEW:
                rows = np.concatenate([np.nonzero(anew)[0], np.arange(known, len(delta))])
                grown = np.zeros((len(delta), 4, 4))
                grown[:known] = self._linearized
                for row in rows.tolist():
                    grown[row] = values.atPose3(self._keys[row]).matrix()
                self._linearized = grown
            else:
                self._linearized = poses_of(values)
        changed = np.ones(len(delta), bool)
        changed[:known] = anew | (delta[:known] != self._delta).any(axis=1)
        poses = np.empty_like(self._linearized)
        poses[:known] = self._poses
        poses[changed] = _retract(self._linearized[changed], delta[changed])
        self._poses, self._delta = poses, delta

    def pose_covariance(self, row: int) -> se3.Array:
        """Return the marginal 6x6 of a pose, body axes, translation first."""
        return se3.covariance_from_gtsam(self._isam.marginalCovariance(X(row)))

    def relative_covariance(self, first: int, second: int) -> se3.Array:
        """Return the 6x6 of T_first_second, body axes of the second, translation first."""
        joint = self._isam.jointMarginalCovariance([X(first), X(second)])
        return relative_covariance(
            self._poses[first], self._poses[second], joint, X(first), X(second)
        )


def _retract(T: se3.Array, delta_rotation_first: NDArray[np.float64]) -> se3.Array:
    """Return T * exp(delta) of each row; delta [N x 6] in GTSAM's order."""
    phi, rho = delta_rotation_first[:, :3], delta_rotation_first[:, 3:]
    angle = np.linalg.norm(phi, axis=1)
    small = angle < 1e-5
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)[:, None]
    b = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)[:, None]
    cross = np.cross(phi, rho)
    moved = rho + a * cross + b * np.cross(phi, cross)
    out = T.copy()
    out[:, :3, :3] = T[:, :3, :3] @ Rotation.from_rotvec(phi).as_matrix()
    out[:, :3, 3] += (T[:, :3, :3] @ moved[:, :, None])[:, :, 0]
    return out
