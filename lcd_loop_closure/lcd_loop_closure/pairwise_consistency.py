"""Tell which loops agree with each other, by odometry's covariance.

Two loops and the odometry between their ends make a cycle that must come back to where it began, up
to the noise on the way (Mangelson et al., Pairwise Consistent Measurement Set Maximization, ICRA
2018). Unlike there, the agreeing sets need not be one clique: odometry over a long way is never
quite as sure as it says, so agreement is only asked of loops whose ends are near each other.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from lcd_common import se3

Rows = NDArray[np.int64]
_PART = 4096  # pairs


@dataclass(frozen=True)
class LoopMeasurements:
    """Loops as arrays: ends [M x 2] rows (match, query), T_match_query [M x 4 x 4], covariances."""

    ends: Rows
    T_match_query: se3.Array
    covariances: se3.Array


class ChainCovariance:
    """Covariance of the motion between any two poses of an odometry chain, in constant time.

    Each link's covariance is carried to the world's axes, where they add up; the difference of two
    sums is the covariance of the way between.
    """

    def __init__(self, poses: se3.Array, motion_covariances: se3.Array) -> None:
        self._poses = poses
        A = adjoints(poses)
        world = A @ motion_covariances @ np.swapaxes(A, 1, 2)
        world[0] = 0.0
        self._sums = np.cumsum(world, axis=0)
        self._inverse_adjoints = adjoints(se3.inverse(poses))

    def motion(self, first: Rows, second: Rows) -> se3.Array:
        """Return T_first_second [K x 4 x 4]."""
        return se3.inverse(self._poses[first]) @ self._poses[second]

    def covariance(self, first: Rows, second: Rows) -> se3.Array:
        """Return the covariances [K x 6 x 6] of motion(), body axes of the second."""
        world = self._sums[np.maximum(first, second)] - self._sums[np.minimum(first, second)]
        A = self._inverse_adjoints[second]
        return A @ world @ np.swapaxes(A, 1, 2)


def cycle_distances(
    chain: ChainCovariance, loops: LoopMeasurements, first: Rows, second: Rows
) -> NDArray[np.float64]:
    """Return the squared Mahalanobis distance [K] of the cycle through each pair of loops.

    first, second: [K] indices of loops. The cycle runs back along the first loop, by odometry to
    the second's match, along the second and by odometry to the first's query.
    """
    i, j = loops.ends[first].T
    k, m = loops.ends[second].T
    T_a, T_b = loops.T_match_query[first], loops.T_match_query[second]
    T_ik, T_mj = chain.motion(i, k), chain.motion(m, j)
    error = log(se3.inverse(T_a) @ T_ik @ T_b @ T_mj)
    through_b = adjoints(se3.inverse(T_b @ T_mj))
    through_m = adjoints(se3.inverse(T_mj))
    covariance = (
        loops.covariances[first]
        + through_b @ chain.covariance(i, k) @ np.swapaxes(through_b, 1, 2)
        + through_m @ loops.covariances[second] @ np.swapaxes(through_m, 1, 2)
        + chain.covariance(m, j)
    )
    return mahalanobis(error, covariance)


def odometry_distances(chain: ChainCovariance, loops: LoopMeasurements) -> NDArray[np.float64]:
    """Return the squared Mahalanobis distance [M] of each loop from odometry alone."""
    i, j = loops.ends.T
    error = log(se3.inverse(loops.T_match_query) @ chain.motion(i, j))
    return mahalanobis(error, loops.covariances + chain.covariance(i, j))


def agreeing_groups(
    chain: ChainCovariance,
    loops: LoopMeasurements,
    threshold: float,
    reach: int = 40,
) -> list[NDArray[np.int64]]:
    """Return groups of two loops or more that agree with each other, largest first.

    Loops whose matches and whose queries both lie within `reach` rows are compared; a group is what
    hangs together by agreement (squared distance at most `threshold`).
    """
    count = len(loops.ends)
    if count < 2:
        return []
    near = cKDTree(loops.ends).query_pairs(reach, p=np.inf, output_type='ndarray')
    first, second = near[np.lexsort(near.T[::-1])].T
    # In parts: a pair takes kilobytes, and on a street driven all day every loop has a hundred.
    agree = np.concatenate(
        [
            cycle_distances(chain, loops, first[k : k + _PART], second[k : k + _PART]) <= threshold
            for k in range(0, max(len(first), 1), _PART)
        ]
    )
    edges = coo_matrix((np.ones(agree.sum()), (first[agree], second[agree])), (count, count))
    _, labels = connected_components(edges, directed=False)
    groups = [np.nonzero(labels == label)[0] for label in np.unique(labels)]
    groups = [group for group in groups if len(group) > 1]
    return sorted(groups, key=lambda group: (-len(group), int(group[0])))


def mahalanobis(error: se3.Array, covariance: se3.Array) -> NDArray[np.float64]:
    """Return the squared Mahalanobis lengths of errors [K x 6] under covariances [K x 6 x 6]."""
    solved = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    return np.einsum('ki,ki->k', error, solved)


def adjoints(T: se3.Array) -> se3.Array:
    """Return se3.adjoint of each of the transforms [N x 4 x 4]."""
    R, t = T[:, :3, :3], T[:, :3, 3]
    skew = np.zeros((len(T), 3, 3))
    skew[:, 0, 1], skew[:, 0, 2], skew[:, 1, 2] = -t[:, 2], t[:, 1], -t[:, 0]
    skew -= np.swapaxes(skew, 1, 2)
    out = np.zeros((len(T), 6, 6))
    out[:, :3, :3] = out[:, 3:, 3:] = R
    out[:, :3, 3:] = skew @ R
    return out


def log(T: se3.Array) -> se3.Array:
    """Return se3.log [N x 6] of each of the transforms [N x 4 x 4]."""
    phi = Rotation.from_matrix(T[:, :3, :3]).as_rotvec().reshape(-1, 3)
    angle = np.linalg.norm(phi, axis=1)
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    # V^-1 = I - phi/2 + (1/a^2 - (1 + cos a) / (2 a sin a)) phi^2, the inverse left Jacobian.
    half = 0.5 * safe
    factor = np.where(small, 1.0 / 12.0, (1.0 - half / np.tan(half)) / safe**2)
    t = T[:, :3, 3]
    cross = np.cross(phi, t)
    rho = t - 0.5 * cross + factor[:, None] * np.cross(phi, cross)
    return np.concatenate([rho, phi], axis=1)
