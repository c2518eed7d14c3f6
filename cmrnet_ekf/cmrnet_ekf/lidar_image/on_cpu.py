"""Make LiDAR images on the processor (numba)."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from cmrnet_ekf.lidar_image.lens import Lens
from cmrnet_ekf.lidar_image.settings import LidarImageConfig
from lcd_common import se3

Floats = NDArray[np.float32]
Counts = NDArray[np.int32]
# Cosines may come out a little above 1; what stops early must not decide otherwise for that.
TWO = np.float32(2.00002)


def depth_image(
    points: Floats, T_camera_points: se3.Array, lens: Lens, s: LidarImageConfig
) -> Floats:
    """Return the depth [H x W] of the nearest point in each pixel, metres; 0 where there is none.

    Args:
        points: [N x 3] float32.
        T_camera_points: from the points' frame to the camera's optical frame.
        lens: of the camera.
        s: which depths count. Nothing is filtered here.
    """
    points = np.ascontiguousarray(points, np.float32)
    T = np.ascontiguousarray(T_camera_points[:3], np.float32)
    numbers = np.array([*lens.focal, *lens.centre], np.float32)
    limits = np.array([s.min_depth, s.max_depth, lens.max_radius_squared], np.float32)
    depth = np.full((lens.height, lens.width), np.inf, np.float32)
    _z_buffer(points, T, numbers, lens.distortion, limits, bool(lens.distortion.any()), depth)
    depth[np.isinf(depth)] = 0.0
    return depth


def without_hidden(depth: Floats, lens: Lens, s: LidarImageConfig) -> Floats:
    """Return the image without pixels that see through a nearer surface.

    CMRNet's filter (visibility2): within each quadrant of the window around a pixel the largest
    cosine between the directions to the neighbour and to the camera; a pixel whose four cosines
    add up to the threshold lies behind something. A quadrant without neighbours counts -1; pixels
    in the same row or column belong to two quadrants.
    """
    if s.radius == 0:
        return depth
    out = np.zeros_like(depth)
    _filter(depth, lens.rays, s.radius, np.float32(s.threshold), out)
    return out


@njit(cache=True, nogil=True, error_model='numpy')
def _z_buffer(
    points: Floats,
    T: Floats,
    numbers: Floats,
    distortion: Floats,
    limits: Floats,
    is_distorted: bool,
    depth: Floats,
) -> None:
    half, one, two = np.float32(0.5), np.float32(1.0), np.float32(2.0)
    fx, fy, cx, cy = numbers[0], numbers[1], numbers[2], numbers[3]
    near, far, fold = limits[0], limits[1], limits[2]
    k1, k2, p1, p2, k3 = distortion[0], distortion[1], distortion[2], distortion[3], distortion[4]
    height, width = depth.shape
    right, bottom = np.float32(width - 0.5), np.float32(height - 0.5)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if not (near <= z <= far):
            continue
        inverse = one / z
        x = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]) * inverse
        y = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]) * inverse
        if is_distorted:
            r2 = x * x + y * y
            if r2 >= fold:
                continue
            radial = one + r2 * (k1 + r2 * (k2 + r2 * k3))
            xd = x * radial + two * p1 * x * y + p2 * (r2 + two * x * x)
            y = y * radial + p1 * (r2 + two * y * y) + two * p2 * x * y
            x = xd
        u = fx * x + cx
        v = fy * y + cy
        if not (-half <= u < right and -half <= v < bottom):
            continue
        column, row = int(u + half), int(v + half)  # positive: this rounds down
        # Half a pixel is added in float32: what is just left of the border may round onto it.
        if column < width and row < height and z < depth[row, column]:
            depth[row, column] = z


@njit(cache=True, nogil=True, error_model='numpy')
def _filter(depth: Floats, rays: Floats, radius: int, threshold: np.float32, out: Floats) -> None:
    height, width = depth.shape
    before, xyz, column = _listed(depth, rays)
    for v in range(height):
        for i in range(before[v, 0], before[v, width]):
            u = column[i]
            begin, end = max(u - radius, 0), min(u + radius, width - 1) + 1
            x, y, z = xyz[i, 0], xyz[i, 1], xyz[i, 2]
            own = np.sqrt(x * x + y * y + z * z)
            beside = _cosines(xyz, column, before[v, begin], before[v, end], i)
            left, right = beside
            # Above first: on level ground what is seen there lies behind, and that decides.
            for row in range(max(v - radius, 0), v):
                found = _cosines(xyz, column, before[row, begin], before[row, end], i)
                left, right = max(left, found[0]), max(right, found[1])
            covered = _cosine(left, own) + _cosine(right, own)
            hidden = covered + TWO >= threshold
            if hidden:
                left, right = beside
                for row in range(v + 1, min(v + radius, height - 1) + 1):
                    found = _cosines(xyz, column, before[row, begin], before[row, end], i)
                    left, right = max(left, found[0]), max(right, found[1])
                hidden = covered + _cosine(left, own) + _cosine(right, own) >= threshold
            if not hidden:
                out[v, u] = z


@njit(cache=True, nogil=True, error_model='numpy')
def _listed(depth: Floats, rays: Floats) -> tuple[Counts, Floats, Counts]:
    """List the filled pixels, so that empty ones cost nothing.

    Returns how many are before each pixel [H x W + 1], their points [N x 3] and columns [N]: a row
    of a window is a piece of the list.
    """
    height, width = depth.shape
    before = np.empty((height, width + 1), np.int32)
    xyz = np.empty((height * width, 3), np.float32)
    column = np.empty(height * width, np.int32)
    count = 0
    for v in range(height):
        for u in range(width):
            before[v, u] = count
            z = depth[v, u]
            if z > 0:
                xyz[count, 0] = rays[v, u, 0] * z
                xyz[count, 1] = rays[v, u, 1] * z
                xyz[count, 2] = z
                column[count] = u
                count += 1
        before[v, width] = count
    return before, xyz[:count], column[:count]


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def _cosines(
    xyz: Floats, column: Counts, begin: int, end: int, i: int
) -> tuple[np.float32, np.float32]:
    """Return the largest signed squares to the left and right, times the ray's squared length."""
    x, y, z, u = xyz[i, 0], xyz[i, 1], xyz[i, 2], column[i]
    left = right = np.float32(-np.inf)
    for k in range(begin, end):
        if k == i:
            continue
        dx, dy, dz = xyz[k, 0] - x, xyz[k, 1] - y, xyz[k, 2] - z
        along = -(dx * x + dy * y + dz * z)
        value = along * abs(along) / (dx * dx + dy * dy + dz * dz)
        if column[k] <= u:
            left = max(left, value)
        if column[k] >= u:
            right = max(right, value)
    return left, right


@njit(cache=True, nogil=True, error_model='numpy', inline='always')
def _cosine(square: np.float32, own: np.float32) -> np.float32:
    if square == np.float32(-np.inf):
        return np.float32(-1.0)
    root = np.sqrt(abs(square)) / own
    return root if square >= 0 else -root
