"""Describe a scan by the heights around the vehicle (Scan Context).

Kim and Kim, "Scan Context: Egocentric Spatial Descriptor for Place Recognition within 3D Point
Cloud Map", IROS 2018; the thesis's strongest hand-crafted baseline. Equation numbers are the
paper's.
"""

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.settings import config, setting

# Sets of columns that are compared at once: bounds the memory of a search, not its result.
_BATCH = 1024


@config
class ScanContextConfig:
    """Shape of the descriptor; the defaults are the paper's."""

    rings: int = setting(20, 'distance bins', low=2, high=200)
    sectors: int = setting(60, 'azimuth bins; the yaw hypothesis has their width', low=4, high=720)
    max_range: float = setting(80.0, 'distance covered by the rings', unit='m', low=5.0)
    height_offset: float = setting(
        0.27, 'added to heights above base_link so that the ground counts as positive', unit='m'
    )
    max_distance: float = setting(
        0.5, 'candidates that look less alike are not registered', low=0.0
    )
    shortlist: int = setting(
        0, 'compare only the keyframes with the nearest ring keys, as the paper does; 0: all', low=0
    )


class ScanContext:
    """Make descriptors and compare one with many.

    A row, what an index stores of a descriptor, is its ring key followed by the spectrum along the
    sectors of its columns scaled to unit length: all column shifts of eq. 6 are then one product.
    """

    name = 'scan_context'
    unit_length = False

    def __init__(self, settings: ScanContextConfig | None = None) -> None:
        self.settings = settings or ScanContextConfig()

    @property
    def max_distance(self) -> float:
        """Descriptors farther apart are of different places."""
        return self.settings.max_distance

    @property
    def length(self) -> int:
        """Numbers in a descriptor."""
        return self.settings.rings * self.settings.sectors

    @property
    def row_length(self) -> int:
        """Numbers in a row."""
        s = self.settings
        return s.rings + 2 * (s.sectors // 2 + 1) * (s.rings + 1)

    def describe(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the descriptor [rings * sectors] float32 of a sweep in the base frame.

        Each bin holds the largest height of its points above `-height_offset` (eq. 1 to 3), zero
        where it has none.
        """
        s, xyz = self.settings, cloud.xyz
        bins = np.zeros(self.length, np.float32)
        distance = np.hypot(xyz[:, 0], xyz[:, 1])
        with np.errstate(invalid='ignore'):
            keep = (distance < s.max_range) & np.isfinite(xyz[:, 2])
        x, y, z = np.asarray(xyz[keep], np.float64).T
        ring = (distance[keep] * (s.rings / s.max_range)).astype(np.int64)
        azimuth = np.arctan2(y, x) % (2.0 * np.pi)
        sector = (azimuth * (s.sectors / (2.0 * np.pi))).astype(np.int64) % s.sectors
        at = np.minimum(ring, s.rings - 1) * s.sectors + sector
        np.maximum.at(bins, at, (z + s.height_offset).astype(np.float32))
        return bins

    def features(self, cloud: PointCloud) -> None:
        """Return None: heights in bins hold no keypoints."""

    def row(self, descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what has to be stored of a descriptor; raises DataError on another length."""
        s = self.settings
        if descriptor.size != self.length:
            raise DataError(
                f'a {s.rings} x {s.sectors} Scan Context has {self.length} numbers, got '
                f'{descriptor.size}; was the map made with other settings?'
            )
        context = np.asarray(descriptor, np.float32).reshape(s.rings, s.sectors)
        norm = np.linalg.norm(context, axis=0)
        unit = np.divide(context, norm, out=np.zeros_like(context), where=norm > 0)
        signal = np.vstack([unit, norm > 0]).astype(np.float32)
        spectrum = np.fft.rfft(signal, axis=1).astype(np.complex64).T
        # The paper counts occupied bins of a ring (eq. 7).
        ring_key = np.mean(context > 0, axis=1, dtype=np.float32)
        return np.concatenate([ring_key, np.ascontiguousarray(spectrum).view(np.float32).ravel()])

    def compare(
        self, query: NDArray[np.float32], rows: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Compare a query row with rows [N x row_length].

        Returns:
            distances [N] float32, 0..1 (eq. 6: the best column shift; columns that are empty in
            either do not count, as in the authors' code), infinity for those off the shortlist; and
            yaw [N] float32, radians: heading of the query in the match.
        """
        s = self.settings
        distance = np.full(len(rows), np.inf, np.float32)
        yaw = np.zeros(len(rows), np.float32)
        chosen = np.arange(len(rows))
        if 0 < s.shortlist < len(rows):
            difference = np.linalg.norm(rows[:, : s.rings] - query[: s.rings], axis=1)
            chosen = np.sort(np.argpartition(difference, s.shortlist)[: s.shortlist])
        conjugate = np.conj(self._spectra(query[None])[0])
        for start in range(0, len(chosen), _BATCH):
            part = chosen[start : start + _BATCH]
            block = rows[start : start + len(part)] if len(chosen) == len(rows) else rows[part]
            spectra = self._spectra(block)
            summed = np.einsum('kfr,fr->kf', spectra[:, :, :-1], conjugate[:, :-1])
            similarity = np.fft.irfft(summed, n=s.sectors, axis=1)
            overlap = np.fft.irfft(spectra[:, :, -1] * conjugate[:, -1], n=s.sectors, axis=1)
            columns = np.rint(overlap)
            similarity = np.divide(
                similarity, columns, out=np.zeros_like(similarity), where=columns > 0
            )
            shift = np.argmax(similarity, axis=1)
            distance[part] = 1.0 - similarity[np.arange(len(part)), shift]
            yaw[part] = shift * (2.0 * np.pi / s.sectors)
        return np.maximum(distance, 0.0), np.where(yaw > np.pi, yaw - 2.0 * np.pi, yaw)

    def _spectra(self, rows: NDArray[np.float32]) -> NDArray[np.complex64]:
        s = self.settings
        flat = np.ascontiguousarray(rows[:, s.rings :]).view(np.complex64)
        return flat.reshape(len(rows), s.sectors // 2 + 1, s.rings + 1)
