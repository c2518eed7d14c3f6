"""Describe a sweep by its density on many planes (M2DP).

He, Wang and Zhang, "M2DP: A Novel 3D Point Cloud Descriptor and Its Application in Loop Closure
Detection", IROS 2016.
"""

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.settings import config, setting
from lcd_loop_closure.descriptor_index import Euclidean


@config
class M2dpConfig:
    """Shape of the descriptor; the defaults are the paper's."""

    azimuths: int = setting(4, 'azimuths of the normals of planes, p in the paper', low=1, high=64)
    elevations: int = setting(
        16, 'elevations of the normals of planes, q in the paper', low=1, high=64
    )
    circles: int = setting(8, 'circles on a plane, l in the paper', low=1, high=64)
    sectors: int = setting(16, 'sectors on a plane, t in the paper', low=2, high=128)
    max_distance: float = setting(
        0.3, 'candidates that look less alike are not registered', low=0.0
    )
    axis_signs: str = setting(
        'skewness',
        'what turns the principal axes to one of their two ends: the longer tail of the points '
        'along them, as invariance under rotation needs, or their largest coordinate in the base '
        "frame, as MATLAB does in the authors' code and which a turned vehicle defeats",
        choices=('skewness', 'largest'),
    )


class M2dp:
    """Make descriptors and compare them by their L2 distance.

    A sweep is moved to its centroid and turned to its principal axes, projected onto planes and
    counted there in bins of angle and radius. The rows of all planes make a matrix; its first left
    and right singular vectors are the descriptor.
    """

    name = 'm2dp'
    unit_length = False

    def __init__(self, settings: M2dpConfig | None = None) -> None:
        self.settings = s = settings or M2dpConfig()
        # [planes x 3] axes of each plane, sampled as in the authors' code.
        self._first, self._second = _plane_axes(
            np.linspace(-np.pi / 2, np.pi / 2, s.azimuths), np.linspace(0, np.pi / 2, s.elevations)
        )
        self._metric = Euclidean(self.length)

    @property
    def max_distance(self) -> float:
        """Descriptors farther apart are of different places."""
        return self.settings.max_distance

    @property
    def length(self) -> int:
        """Numbers in a descriptor: planes and bins."""
        s = self.settings
        return s.azimuths * s.elevations + s.circles * s.sectors

    @property
    def row_length(self) -> int:
        """Numbers in a row."""
        return self.length

    def describe(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the descriptor [planes + bins] float32; zeros of a cloud below three points."""
        xyz = np.asarray(cloud.finite().xyz, np.float64)
        if len(xyz) < 3:
            return np.zeros(self.length, np.float32)
        U, _, Vt = np.linalg.svd(self.signature(xyz), full_matrices=False)
        # Counts are never negative: neither are the first singular vectors, but for a common sign.
        return np.concatenate([np.abs(U[:, 0]), np.abs(Vt[0])]).astype(np.float32)

    def signature(self, xyz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the share of the points [N x 3] in each bin of each plane, [planes x bins]."""
        s = self.settings
        # Single precision moves points across the edge of a bin at most, and halves the time.
        aligned = aligned_to_axes(xyz, s.axis_signs).astype(np.float32)
        # Radii of the circles grow with the square of their number up to the farthest point.
        reach = np.float32(np.linalg.norm(aligned, axis=1).max() + 1e-3)
        per_radian = np.float32(s.sectors / (2.0 * np.pi))
        shares = np.empty((len(self._first), s.circles * s.sectors))
        for plane, (first, second) in enumerate(zip(self._first, self._second, strict=True)):
            x, y = aligned @ first, aligned @ second
            angle = np.arctan2(y, x) + np.float32(np.pi)
            sector = np.minimum((angle * per_radian).astype(np.int32), s.sectors - 1)
            root = np.sqrt(np.sqrt(x * x + y * y) / reach)
            circle = np.minimum((root * np.float32(s.circles)).astype(np.int32), s.circles - 1)
            counts = np.bincount(circle * s.sectors + sector, minlength=shares.shape[1])
            shares[plane] = counts / len(xyz)
        return shares

    def features(self, cloud: PointCloud) -> None:
        """Return None: there are no keypoints to register by."""

    def row(self, descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the descriptor; raises DataError on another length."""
        return self._metric.row(descriptor)

    def compare(
        self, query: NDArray[np.float32], rows: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], None]:
        """Return the L2 distances [N]; M2DP tells no yaw."""
        return self._metric.compare(query, rows)


def aligned_to_axes(xyz: NDArray[np.float64], signs: str) -> NDArray[np.float64]:
    """Return points [N x 3] from their centroid along their principal axes, longest first.

    The axes stay right-handed: the sign of the first and the third are chosen, the second follows.
    """
    centred = xyz - xyz.mean(axis=0)
    _, axes = np.linalg.eigh(centred.T @ centred)
    first, third = axes[:, 2], axes[:, 0]
    if signs == 'skewness':
        first = first * _sign(np.sum((centred @ first) ** 3))
        third = third * _sign(np.sum((centred @ third) ** 3))
    else:
        first = first * _sign(first[np.argmax(np.abs(first))])
        third = third * _sign(third[np.argmax(np.abs(third))])
    return np.asarray(centred @ np.column_stack([first, np.cross(third, first), third]))


def _sign(value: float) -> float:
    return -1.0 if value < 0 else 1.0


def _plane_axes(
    azimuths: NDArray[np.float64], elevations: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return two unit axes [planes x 3] of each plane, the first along the projected x axis."""
    azimuth, elevation = (a.ravel() for a in np.meshgrid(azimuths, elevations, indexing='ij'))
    normal = np.stack(
        [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ],
        axis=1,
    )
    along = np.eye(3)[0] - normal[:, :1] * normal
    # A plane across the x axis has no projection of it.
    along = np.where(np.linalg.norm(along, axis=1, keepdims=True) > 1e-9, along, np.eye(3)[1])
    first = along / np.linalg.norm(along, axis=1, keepdims=True)
    return first.astype(np.float32), np.cross(normal, first).astype(np.float32)
