"""Register two clouds without an initial guess by comparing them from above.

Vehicles are aligned to gravity, so only yaw, x and y have to be searched, and they can be searched
exhaustively: every yaw of a grid, every shift by FFT correlation of the bird's-eye views of what
stands on the ground. Nothing is sampled at random, so the same clouds give the same answer, and a
reverse pass or a lateral offset is no harder than a same-way one. The result is good to a few
decimetres and about a degree; GICP (refinement.py) takes it from there.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lcd_common import se3
from lcd_common.settings import config, setting


@config
class BevConfig:
    """Search space and resolution of the registration from above."""

    cell: float = setting(1.5, 'side of a cell', unit='m', low=0.1, high=5.0)
    radius: float = setting(60.0, 'structure farther than this is ignored', unit='m', low=10.0)
    max_shift: float = setting(
        45.0,
        'largest distance searched along x and y; wider than what is accepted, so that in a street '
        'that repeats itself the true answer can win',
        unit='m',
        low=1.0,
    )
    yaw_step: float = setting(
        3.0, 'step of the exhaustive yaw search', unit='deg', low=0.5, high=30
    )
    min_height: float = setting(
        0.5, 'a column of points at least this tall stands on the ground', unit='m', low=0.05
    )
    full_height: float = setting(
        3.0, 'columns at least this tall weigh the same', unit='m', low=0.1
    )
    hypotheses: int = setting(3, 'best distinct peaks that are handed on', low=1, high=50)
    ground_radius: float = setting(
        15.0, 'ground height is taken from points within this distance', unit='m', low=2.0
    )


@dataclass(frozen=True)
class BevView:
    """What a cloud looks like from above: columns that stand on the ground.

    Attributes:
        xy: [M x 2] float32 mean position of the points of each column, metres, base frame.
        weight: [M] float32, 0..1, grows with the height of the column.
        ground_z: height of the ground around the vehicle, metres, base frame.
    """

    xy: NDArray[np.float32]
    weight: NDArray[np.float32]
    ground_z: float


@dataclass(frozen=True)
class BevHypothesis:
    """One answer of the search.

    Attributes:
        T_match_query: rough pose of the query in the match, roll and pitch zero.
        score: correlation of the two views, 0..1.
    """

    T_match_query: se3.Array
    score: float


class BevRegistration:
    """Find the few most likely poses of one cloud in another by exhaustive correlation."""

    def __init__(self, settings: BevConfig | None = None) -> None:
        self.settings = settings or BevConfig()
        s = self.settings
        self._reach = int(np.ceil(s.max_shift / s.cell))
        # The image wraps around: at this size no shift within reach brings structure back in.
        half = int(np.ceil(s.radius / s.cell)) + self._reach
        self._size = fft.next_fast_len(2 * half + 2, real=True)
        turns = 2 * max(2, round(180.0 / s.yaw_step))
        self._yaws = 2.0 * np.pi / turns * np.arange(turns)

    def view(self, xyz: NDArray[np.floating]) -> BevView:
        """Reduce a cloud [N x 3] (base frame, metres) to its view from above."""
        s = self.settings
        xyz = np.asarray(xyz, np.float32)
        flat = np.hypot(xyz[:, 0], xyz[:, 1])
        near = xyz[flat <= s.ground_radius, 2]
        # A low percentile, not the minimum: single returns from below the road are common.
        ground_z = float(np.percentile(near, 10)) if len(near) else 0.0
        xyz = xyz[flat <= s.radius + s.max_shift]
        half_cell = 0.5 * s.cell
        span = int(2 * (s.radius + s.max_shift) / half_cell) + 2
        index = np.floor(xyz[:, :2] / half_cell).astype(np.int64) + span // 2
        key = index[:, 0] * span + index[:, 1]
        order = np.argsort(key, kind='stable')
        key, xyz = key[order], xyz[order]
        start = np.flatnonzero(np.r_[True, key[1:] != key[:-1]]) if len(key) else np.empty(0, int)
        if not len(start):
            return BevView(np.empty((0, 2), np.float32), np.empty(0, np.float32), ground_z)
        height = np.maximum.reduceat(xyz[:, 2], start) - np.minimum.reduceat(xyz[:, 2], start)
        count = np.diff(np.r_[start, len(key)])
        xy = np.add.reduceat(xyz[:, :2], start) / count[:, None]
        tall = height >= s.min_height
        weight = np.minimum(height[tall] / s.full_height, 1.0)
        return BevView(xy[tall].astype(np.float32), weight.astype(np.float32), ground_z)

    def spectra(self, query: BevView) -> NDArray[np.complex64]:
        """Return the spectra [yaws/2 x n x n/2+1] of the query turned to the first half of yaws.

        Half a turn more is the conjugate. They depend on the query alone; compute them once for all
        its candidates.
        """
        yaws = self._yaws[: len(self._yaws) // 2]
        keep = np.hypot(query.xy[:, 0], query.xy[:, 1]) <= self.settings.radius
        xy, weight = query.xy[keep], query.weight[keep]
        images = np.empty((len(yaws), self._size, self._size), np.float32)
        for image, yaw in zip(images, yaws, strict=True):
            c, s = np.cos(yaw), np.sin(yaw)
            turned = xy @ np.array([[c, s], [-s, c]], np.float32)
            image[:] = self._image(turned, weight)
        spectra: NDArray[np.complex64] = fft.rfft2(images, overwrite_x=True)
        return spectra

    def search(
        self, match: BevView, spectra: NDArray[np.complex64], query: BevView
    ) -> list[BevHypothesis]:
        """Return the best distinct poses of the query in the match, best first."""
        s = self.settings
        if not len(match.xy) or not len(query.xy):
            return []
        target = self._image(match.xy, match.weight)
        shifts = np.arange(-self._reach, self._reach + 1)
        # Only shifts within reach are transformed back, first rows, then columns.
        spectrum, half = fft.rfft2(target), len(spectra)
        product = np.empty((2 * half, *spectrum.shape), np.complex64)
        np.multiply(spectrum, np.conj(spectra), out=product[:half])
        np.multiply(spectrum, spectra, out=product[half:])
        rows = fft.ifft(product, axis=1, overwrite_x=True)[:, shifts]
        volume = fft.irfft(rows, n=self._size, axis=2)[:, :, shifts]
        norm = float(np.linalg.norm(target) * np.sqrt(np.sum(query.weight**2)))
        volume = volume / max(norm, 1e-9)
        peaks = volume.copy()
        found: list[BevHypothesis] = []
        for _ in range(s.hypotheses):
            i, j, k = np.unravel_index(int(np.argmax(peaks)), peaks.shape)
            score = float(peaks[i, j, k])
            if score <= 0.0:
                break
            turn, row, column = _between_samples(volume, int(i), int(j), int(k))
            T = se3.rotation_z(turn * float(self._yaws[1]))
            T[:2, 3] = (row - self._reach) * s.cell, (column - self._reach) * s.cell
            T[2, 3] = match.ground_z - query.ground_z
            found.append(BevHypothesis(T, score))
            self._suppress(peaks, int(i), int(j), int(k))
        return found

    def _suppress(self, volume: NDArray[np.float32], i: int, j: int, k: int) -> None:
        """Remove a peak and its flanks so that the next one is another answer."""
        turns = np.arange(i - 3, i + 4) % len(volume)
        reach = max(1, round(3.0 / self.settings.cell))
        volume[
            turns, max(j - reach, 0) : j + reach + 1, max(k - reach, 0) : k + reach + 1
        ] = -np.inf

    def _image(self, xy: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
        """Splat columns bilinearly into an image whose cell (0, 0) is the origin, wrapping."""
        n = self._size
        at = xy / self.settings.cell
        low = np.floor(at)
        f = at - low
        row, column = low.astype(np.int64).T % n
        row_next, column_next = (row + 1) % n, (column + 1) % n
        keys = np.concatenate(
            [
                row * n + column,
                row * n + column_next,
                row_next * n + column,
                row_next * n + column_next,
            ]
        )
        f0, f1 = f[:, 0], f[:, 1]
        parts = np.concatenate(
            [(1 - f0) * (1 - f1), (1 - f0) * f1, f0 * (1 - f1), f0 * f1]
        ) * np.tile(weight, 4)
        image = np.bincount(keys, parts, minlength=n * n).reshape(n, n)
        # Many scan lines in one cell say no more than one.
        return np.minimum(image, 1.0).astype(np.float32)


def _between_samples(
    volume: NDArray[np.float32], i: int, j: int, k: int
) -> tuple[float, float, float]:
    """Return the top of the parabolas through a peak and its neighbours; yaw (axis 0) wraps."""
    middle = float(volume[i, j, k])
    out = []
    for axis, at in enumerate((i, j, k)):
        length = volume.shape[axis]
        if axis > 0 and not 0 < at < length - 1:
            out.append(float(at))
            continue
        low, high = [i, j, k], [i, j, k]
        low[axis], high[axis] = at - 1, (at + 1) % length
        before, after = float(volume[tuple(low)]), float(volume[tuple(high)])
        curvature = before - 2.0 * middle + after
        out.append(at + (0.5 * (before - after) / curvature if curvature < -1e-12 else 0.0))
    return out[0], out[1], out[2]
