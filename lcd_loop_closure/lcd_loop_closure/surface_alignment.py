"""Polish a pose against the surfaces of the local map, and tell how well they hold it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.se3 import Array
from lcd_loop_closure.voxel_gaussians import VoxelGaussians

_MIN_POINTS = 6  # a voxel of fewer has no surface worth the name
_THIN = 0.15  # share of the voxel's size: thinner than this is a surface, wider is not
_STEEP = 0.7  # cosine of 45 degrees
_FLOOR_M = 0.002  # quantisation of ranges and angles; keeps weights finite
_ROUNDS = 12  # Gauss-Newton steps at most; each looks up its voxels afresh. Three are usual
_CONVERGED_M, _CONVERGED_RAD = 1e-3, 1e-4
_REACH = (0.4, 0.15)  # voxels, in the first rounds
_HELD = 0.5  # share of a direction's information that must be more than noise of the normals


@dataclass(frozen=True)
class SurfaceMatches:
    """Distances of points to the map's surfaces at one pose, linearised.

    Attributes:
        residual: [M] metres, along each surface's normal.
        jacobian: [M x 6] of the residual, by a right perturbation of the pose.
        weight: [M] 1/m^2, inverse variance of the residual; robust.
        noise: [M] m^2, variance of the residual by the range's noise alone.
        information_bias: 6x6, what the noise of the normals adds to the information in the mean.
        point: [M] index of the point of each row.
        fitness: share of all points that lie where the map has matter, near its surfaces.
    """

    residual: Array
    jacobian: Array
    weight: Array
    noise: Array
    information_bias: Array
    point: NDArray[np.intp]
    fitness: float

    @property
    def rmse_m(self) -> float:
        """Weighted root mean square of the residuals, metres."""
        if len(self.residual) == 0:
            return float('inf')
        return float(np.sqrt(np.average(self.residual**2, weights=self.weight)))


def match_surfaces(
    points: Array,
    T_map_lidar: Array,
    surfaces: VoxelGaussians,
    range_noise: float,
    reach: float = 0.0,
) -> SurfaceMatches:
    """Measure points against the map's surfaces.

    A flat voxel holds its points along its normal; one that is thin in two directions and upright
    (a pole, a trunk) holds them in both. A thin lying line is one ring of the scanner on the
    ground: its normal is anybody's guess, and it moves along with the vehicle; it is left out.

    Args:
        points: [N x 3] of the lidar frame, metres.
        T_map_lidar: pose of the lidar.
        surfaces: the map.
        range_noise: standard deviation of a range, metres.
        reach: residuals up to here are no outliers, metres.
    """
    R = T_map_lidar[:3, :3]
    placed = points @ R.T + T_map_lidar[:3, 3]
    slots = surfaces.find(placed, _MIN_POINTS)
    index = np.nonzero(slots >= 0)[0]
    map_ = surfaces.gaussians(slots[index])
    offset = placed[index] - map_.mean
    variance, axes = map_.variance, map_.axes
    thin = (_THIN * surfaces.voxel_size) ** 2
    flat = (variance[:, 0] < thin) & (variance[:, 1] > thin)
    upright = np.abs(axes[:, :, 2] @ R[:, 2]) > _STEEP
    pole = (variance[:, 1] < thin) & (variance[:, 2] > thin) & upright
    uses = [flat | pole, pole]
    rows = [np.nonzero(use)[0] for use in uses]
    row = np.concatenate(rows)
    side = np.repeat([0, 1], [len(r) for r in rows])
    normal = axes[row, :, side]
    residual = np.einsum('ij,ij->i', normal, offset[row])
    # The beam's noise counts by how squarely it meets the surface.
    beam = placed[index[row]] - T_map_lidar[:3, 3]
    squareness = np.einsum('ij,ij->i', normal, beam) / np.linalg.norm(beam, axis=1)
    noise = range_noise**2 * squareness**2 + _FLOOR_M**2
    # Grazing beams are no better than square ones in truth: a scanner's angles have errors too.
    spread = range_noise**2 + variance[row, side]
    scaled = np.abs(residual) / np.sqrt(spread)
    # Geman-McClure as in KISS-ICP, at three times the typical residual.
    scale = 3.0 * max(1.4826 * float(np.median(scaled)) if len(scaled) else 1.0, 0.5)
    width = np.maximum(scale * np.sqrt(spread), reach)
    weight = 1.0 / spread / (1.0 + (residual / width) ** 2) ** 2
    jacobian = _jacobian(points[index[row]], normal @ R)
    near = slots >= 0
    near[index[row[np.abs(residual) > 3.0 * np.sqrt(spread)]]] = False
    bias = _information_bias(points[index], R, weight, row, side, axes, variance, map_.count, noise)
    return SurfaceMatches(
        residual,
        jacobian,
        weight,
        noise,
        bias,
        index[row],
        float(near.mean()) if len(near) else 0.0,
    )


def polish(
    points: Array,
    T_map_lidar: Array,
    surfaces: VoxelGaussians,
    range_noise: float,
    prior_information: Array,
) -> Array:
    """Return the pose that minimises the robust distances to the surfaces, by Gauss-Newton.

    Args:
        points: [N x 3] of the lidar frame, metres.
        T_map_lidar: where to start, and what the prior holds on to.
        surfaces: the map.
        range_noise: standard deviation of a range, metres.
        prior_information: 6x6; keeps the directions that the surfaces do not hold.
    """
    T = T_map_lidar
    for round_ in range(_ROUNDS):
        # Most points lie on the ground and along the street, where a pose that is wrong along it
        # fits: the few that tell must not be outliers from the first.
        reach = _REACH[round_] * surfaces.voxel_size if round_ < len(_REACH) else 0.0
        matches = match_surfaces(points, T, surfaces, range_noise, reach)
        information, held = held_information(matches)
        gradient = held.T @ matches.jacobian.T @ (matches.weight * matches.residual)
        away = se3.log(se3.inverse(T_map_lidar) @ T)
        step = -np.linalg.solve(
            information + prior_information, gradient + prior_information @ away
        )
        T = T @ se3.exp(step)
        if reach:
            continue
        if np.linalg.norm(step[:3]) < _CONVERGED_M and np.linalg.norm(step[3:]) < _CONVERGED_RAD:
            break
    return T


def held_information(matches: SurfaceMatches) -> tuple[Array, Array]:
    """Return what the surfaces truly say about the pose.

    Along a smooth corridor the normals' noise alone seems to hold the vehicle, and would move it.
    Directions in which more than half of the information is such noise are left out (in spirit the
    solution remapping of Zhang, Kaess and Singh, ICRA 2016).

    Returns:
        The information matrix 6x6, less the noise's share, and the 6x6 projection that takes
        gradients to the directions that are held.
    """
    J, w = matches.jacobian, matches.weight
    full = J.T @ (J * w[:, None])
    # In the directions that simultaneously diagonalise `full` (to one) and the bias.
    values, vectors = np.linalg.eigh(full)
    values = np.maximum(values, 1e-12 * max(float(values[-1]), 1.0))
    whiten = vectors / np.sqrt(values)
    feigned, turn = np.linalg.eigh(whiten.T @ matches.information_bias @ whiten)
    basis = whiten @ turn  # basis.T @ full @ basis is the identity
    keep = feigned < 1.0 - _HELD
    back = full @ basis  # the inverse transpose of the basis
    information = (back[:, keep] * (1.0 - feigned[keep])) @ back[:, keep].T
    return information, basis[:, keep] @ back[:, keep].T


def _jacobian(points: Array, normal_lidar: Array) -> Array:
    """Return d(n . (T exp(xi) p))/d(xi) [M x 6] for normals of the lidar frame: n, p x n."""
    (x, y, z), (u, v, w) = points.T, normal_lidar.T
    # numpy's own cross product is slow on short arrays.
    return np.column_stack([normal_lidar, y * w - z * v, z * u - x * w, x * v - y * u])


def _information_bias(
    points: Array,
    R: Array,
    weight: Array,
    row: NDArray[np.intp],
    side: NDArray[np.int64],
    axes: Array,
    variance: Array,
    count: Array,
    noise: Array,
) -> Array:
    """Return what the tilt of noisy normals adds to the information matrix, 6x6.

    A normal fitted to n points with variance l0 across and la along axis a is tilted towards a with
    the variance l0 / (n la). In a smooth corridor that tilt alone would seem to hold the vehicle
    along it (errors in variables).
    """
    bias = np.zeros((6, 6))
    across = np.maximum(variance[row, side], noise)
    pole = np.zeros(len(points), bool)
    pole[row[side == 1]] = True
    pole_rows = pole[row]
    for axis in (1, 2):
        use = ~pole_rows if axis == 1 else np.ones(len(row), bool)
        r = row[use]
        tilt = across[use] / (count[r] * variance[r, axis])
        jacobian = _jacobian(points[r], axes[r, :, axis] @ R)
        bias += jacobian.T @ (jacobian * (weight[use] * tilt)[:, None])
    return bias
