"""Describe a scan by the intensities around the vehicle (Intensity Scan Context).

Wang, Wang and Xie, "Intensity Scan Context: Coding Intensity and Geometry Relations for Loop
Closure Detection", ICRA 2020.
"""

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.settings import config, setting

# Descriptors compared at once: bounds the memory of a search, not its result.
_BATCH = 1024


@config
class IntensityScanContextConfig:
    """Shape of the descriptor and of its comparison."""

    rings: int = setting(20, 'distance bins', low=2, high=200)
    sectors: int = setting(60, 'azimuth bins; the yaw hypothesis has their width', low=4, high=720)
    max_range: float = setting(80.0, 'distance covered by the rings', unit='m', low=5.0)
    min_height: float = setting(
        0.83,
        "points lower above the ground are left out, as the ground in the authors' code, where "
        "the limit is -0.9 m from KITTI's LiDAR",
        unit='m',
    )
    full_intensity: float = setting(1.0, 'intensity of the brightest return', low=1e-3)
    turn_tolerance: int = setting(
        0, 'sectors around the turn of the best geometry in which intensities are compared', low=0
    )
    max_distance: float = setting(
        0.4, 'candidates that look less alike are not registered', low=0.0
    )
    min_geometry: float = setting(
        0.0,
        'share of bins that must agree to be occupied or free; what agrees less is no candidate '
        '(the fast first stage of the paper); 0 keeps all',
        low=0.0,
        high=1.0,
    )


class IntensityScanContext:
    """Make descriptors and compare one with many, in two stages.

    The turn comes from the occupied bins, by counting those that agree over all turns; the distance
    from the cosines of the columns' intensities at that turn. Clouds without intensity cannot be
    described: `describe` raises.
    """

    name = 'intensity_scan_context'
    unit_length = False

    def __init__(self, settings: IntensityScanContextConfig | None = None) -> None:
        self.settings = settings or IntensityScanContextConfig()

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
        """Numbers in a row: the spectra of occupancy, of unit columns and of which are empty."""
        return 2 * self._frequencies * (2 * self.settings.rings + 1) + 1

    def describe(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the largest intensity, 0..1, in each bin [rings * sectors], zero where none is.

        Raises:
            DataError: the sweep has no intensities, to which this descriptor does not apply.
        """
        s = self.settings
        if cloud.intensity is None:
            raise DataError(
                'Intensity Scan Context is not applicable: the sweep has no intensities; '
                'use another descriptor for this sensor'
            )
        x, y, z = np.asarray(cloud.xyz, np.float64).T
        distance = np.hypot(x, y)
        with np.errstate(invalid='ignore'):
            keep = (distance < s.max_range) & (z >= s.min_height) & np.isfinite(z)
        keep &= np.isfinite(cloud.intensity)
        ring = np.minimum((distance[keep] * (s.rings / s.max_range)).astype(int), s.rings - 1)
        azimuth = np.arctan2(y[keep], x[keep]) % (2.0 * np.pi)
        sector = (azimuth * (s.sectors / (2.0 * np.pi))).astype(int) % s.sectors
        bins = np.zeros(self.length, np.float32)
        share = np.clip(cloud.intensity[keep] / s.full_intensity, 0.0, 1.0)
        np.maximum.at(bins, ring * s.sectors + sector, share.astype(np.float32))
        return bins

    def features(self, cloud: PointCloud) -> None:
        """Return None: there are no keypoints to register by."""

    def row(self, descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what has to be stored of a descriptor; raises DataError on another length."""
        s = self.settings
        if descriptor.size != self.length:
            raise DataError(
                f'a {s.rings} x {s.sectors} Intensity Scan Context has {self.length} numbers, got '
                f'{descriptor.size}; was the map made with other settings?'
            )
        image = np.asarray(descriptor, np.float32).reshape(s.rings, s.sectors)
        norm = np.linalg.norm(image, axis=0)
        unit = np.divide(image, norm, out=np.zeros_like(image), where=norm > 0)
        occupied = image > 0
        signal = np.vstack([occupied, unit, norm > 0]).astype(np.float32)
        spectrum = np.fft.rfft(signal, axis=1).astype(np.complex64).T
        flat = np.ascontiguousarray(spectrum).view(np.float32).ravel()
        return np.append(flat, np.float32(occupied.sum()))

    def compare(
        self, query: NDArray[np.float32], rows: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Compare a query row with rows [N x row_length].

        Returns:
            distances [N] float32: one minus the mean cosine of the columns' intensities (columns
            that are empty in either do not count), infinity below `min_geometry`; and yaw [N]
            float32, radians: heading of the query in the match.
        """
        s = self.settings
        distance = np.empty(len(rows), np.float32)
        shift = np.empty(len(rows), np.int64)
        conjugate = np.conj(self._spectra(query[None])[0])
        for start in range(0, len(rows), _BATCH):
            part = slice(start, min(start + _BATCH, len(rows)))
            spectra = self._spectra(rows[part])
            both, cosines, columns = (
                self._over_turns(spectra[:, :, of], conjugate[:, of])
                for of in (slice(0, s.rings), slice(s.rings, 2 * s.rings), slice(-1, None))
            )
            agreeing = self.length - rows[part, -1:] - query[-1] + 2.0 * np.rint(both)
            turn = np.argmax(agreeing, axis=1)
            within = turn[:, None] + np.arange(-s.turn_tolerance, s.turn_tolerance + 1)
            within %= s.sectors
            columns = np.rint(np.take_along_axis(columns, within, axis=1))
            similarity = np.take_along_axis(cosines, within, axis=1)
            similarity = np.divide(
                similarity, columns, out=np.zeros_like(similarity), where=columns > 0
            )
            best = np.argmax(similarity, axis=1)[:, None]
            shift[part] = np.take_along_axis(within, best, axis=1)[:, 0]
            found = np.maximum(1.0 - np.take_along_axis(similarity, best, axis=1)[:, 0], 0.0)
            geometry = agreeing.max(axis=1) / self.length
            distance[part] = np.where(geometry >= s.min_geometry, found, np.inf)
        yaw = (shift * (2.0 * np.pi / s.sectors)).astype(np.float32)
        return distance, np.where(yaw > np.pi, yaw - np.float32(2.0 * np.pi), yaw)

    @property
    def _frequencies(self) -> int:
        return self.settings.sectors // 2 + 1

    def _spectra(self, rows: NDArray[np.float32]) -> NDArray[np.complex64]:
        flat = np.ascontiguousarray(rows[:, :-1]).view(np.complex64)
        return flat.reshape(len(rows), self._frequencies, -1)

    def _over_turns(
        self, spectra: NDArray[np.complex64], conjugate: NDArray[np.complex64]
    ) -> NDArray[np.float64]:
        """Return the sum of products [N x sectors] for every turn of the query."""
        summed = np.einsum('kfr,fr->kf', spectra, conjugate)
        return np.fft.irfft(summed, n=self.settings.sectors, axis=1)
