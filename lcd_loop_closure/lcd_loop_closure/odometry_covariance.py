"""Tell how far a registered pose can be off, from the normal equations and their residuals."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common.se3 import Array
from lcd_loop_closure.surface_alignment import SurfaceMatches, held_information

# A third of the noise per sweep keeps the sum over 2 to 18 sweeps within a factor of 3 of 2 P.
_CHAINED = 1.0 / 3.0


@dataclass(frozen=True)
class MotionCovariance:
    """Covariances of one motion, 6x6, body axes, translation first.

    Attributes:
        step: of this motion alone.
        growth: what it adds to the covariance of a chain of motions.
    """

    step: Array
    growth: Array


def motion_covariance(
    matches: SurfaceMatches,
    points: Array,
    prior_information: Array,
    *,
    cell_size: float,
    renewed: float,
) -> MotionCovariance:
    """Return the covariance of the motion since the last sweep.

    A pose registered against the map has the covariance P = `A^-1 B A^-1`, the sandwich of an
    M-estimator (Huber 1967; clustered: Liang and Zeger 1986). `A` is the information of the normal
    equations, less what noisy normals feign, plus the prior's. `B` sums what the residuals did: the
    outer products of the gradients of whole cells of space, as the residuals of neighbours share
    the errors of the map under them.

    A motion lies between two poses, so it has 2 P; but what the two share cancels. Errors of the
    map stay the same while the vehicle stands and are drawn anew as it sees other points of the
    surfaces: `renewed` (0..1) is how much of them was. What is left of `B` for a vehicle that
    stands is the noise of the ranges, new in every sweep.

    In a chain each pose's error leaves with the next motion as it came with the last: 2 P of the
    two ends stay, however long it is. As covariances of motions can only be added up, `growth` is
    what makes the sum about right over the few voxels of travel, or the few sweeps of a slow
    vehicle, that lie between two keyframes.

    Args:
        matches: of the points at the registered pose.
        points: [N x 3] of the lidar frame, metres.
        prior_information: 6x6, what is known without the sweep.
        cell_size: edge of the cells in which residuals are taken for dependent, metres.
        renewed: share of the surface sampling that is new since the last sweep.
    """
    information, held = held_information(matches)
    weighted = matches.jacobian * matches.weight[:, None] @ held
    cells = np.floor(points[matches.point] / cell_size).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    count = int(cell.max()) + 1 if len(cell) else 0
    gradient = weighted * matches.residual[:, None]
    sums = np.stack([np.bincount(cell.ravel(), g, count) for g in gradient.T], axis=1)
    shared = sums.T @ sums * (count / max(count - 1, 1))
    noise = weighted.T @ (weighted * matches.noise[:, None])
    inverse = np.linalg.inv(information + prior_information)
    step = 2.0 * (renewed * shared + (1.0 - renewed) * noise) + prior_information
    growth = renewed * shared + _CHAINED * (1.0 - renewed) * noise + prior_information
    return MotionCovariance(_around(inverse, step), _around(inverse, growth))


def _around(inverse: NDArray[np.floating], middle: NDArray[np.floating]) -> Array:
    covariance = inverse @ middle @ inverse
    return np.asarray(0.5 * (covariance + covariance.T))


def lost_covariance(translation: float, heading: float) -> MotionCovariance:
    """Return the covariance of a motion that nothing confirms.

    Args:
        translation: standard deviation of each axis, metres.
        heading: of the yaw, radians; roll and pitch, which a vehicle hardly changes, get a tenth.
    """
    sigma = np.array([translation] * 3 + [0.1 * heading, 0.1 * heading, heading])
    covariance = np.diag(sigma**2)
    return MotionCovariance(covariance, covariance)
