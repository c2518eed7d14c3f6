"""Describe a scan as the iris of an eye (LiDAR-Iris).

Wang et al., "LiDAR Iris for Loop-Closure Detection", IROS 2020.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError, DataError
from lcd_common.settings import config, setting

# Descriptors compared at once: bounds the memory of a search, not its result.
_BATCH = 64
_BITS = 8  # of a pixel, one for each slice of height
_WORD = 64


@config
class LidarIrisConfig:
    """Shape of the image, filters and comparison; the defaults are the authors'."""

    rings: int = setting(80, 'distance bins', low=8, high=400)
    sectors: int = setting(360, 'azimuth bins; the yaw hypothesis has their width', low=36)
    ring_width: float = setting(1.0, 'width of a distance bin', unit='m', low=0.1)
    slice_height: float = setting(1.0, 'height of the eight slices', unit='m', low=0.05)
    lowest: float = setting(
        -3.27,
        'height above the ground where the second slice begins; all lower points are in the first '
        "one, all above the last in that; -5 m from KITTI's LiDAR",
        unit='m',
    )
    scales: int = setting(4, 'LoG-Gabor filters', low=1, high=16)
    wavelength: float = setting(18.0, 'of the first filter, in sectors', low=2.0)
    growth: float = setting(1.6, 'of the wavelength from filter to filter', low=1.0)
    bandwidth: float = setting(0.75, 'sigma of a filter over its frequency', low=0.1, high=0.99)
    max_distance: float = setting(
        0.4, 'candidates that look less alike are not registered', low=0.0
    )
    peaks: int = setting(
        2,
        'turns that are tried, the best of a correlation of phases; 0: all turns, whose best these '
        'find in 99 of 100 pairs and in a tenth of the time',
        low=0,
        high=100,
    )
    turn_tolerance: int = setting(2, 'sectors tried on both sides of a peak', low=0, high=20)
    turn_filter: int = setting(1, 'filter whose phases are correlated, from 0', low=0)
    frequencies: int = setting(40, 'of the correlation, lowest first', low=4)


class LidarIris:
    """Make descriptors and compare one with many.

    A pixel of the image holds a bit for each slice of height that is occupied. A row, what an index
    stores, holds the signs of the real and imaginary responses of LoG-Gabor filters along the
    image's rows as bits, which image rows are blank, and the spectrum of the phases of one filter's
    responses. The distance of two is the share of bits that differ, blank rows left out, at the
    best turn. The paper finds the turn by the phase correlation of the images, which missed it in a
    fifth to a third of the reverse pairs three to four metres apart in a validation town; here the
    phases of the responses are correlated.
    """

    name = 'lidar_iris'
    unit_length = False

    def __init__(self, settings: LidarIrisConfig | None = None) -> None:
        """Check the settings.

        Raises:
            ConfigError: there is no filter of the number `turn_filter`.
        """
        self.settings = s = settings or LidarIrisConfig()
        if s.turn_filter >= s.scales:
            raise ConfigError(f'turn_filter must be below scales = {s.scales}, got {s.turn_filter}')
        self._features = 2 * s.scales * s.rings
        self._words = -(-self._features // _WORD)
        self._frequencies = min(s.frequencies, s.sectors // 2)

    @property
    def max_distance(self) -> float:
        """Descriptors farther apart are of different places."""
        return self.settings.max_distance

    @property
    def length(self) -> int:
        """Numbers in a descriptor: the pixels."""
        return self.settings.rings * self.settings.sectors

    @property
    def row_length(self) -> int:
        """Numbers in a row."""
        s = self.settings
        return 2 * self._words * (s.sectors + 1) + 2 * self._frequencies * s.rings

    def describe(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the image [rings * sectors] float32 of a sweep in the base frame, codes 0..255."""
        s = self.settings
        x, y, z = np.asarray(cloud.finite().xyz, np.float64).T
        ring = (np.hypot(x, y) / s.ring_width).astype(int)
        azimuth = np.arctan2(y, x) % (2.0 * np.pi)
        sector = (azimuth * (s.sectors / (2.0 * np.pi))).astype(int) % s.sectors
        height = np.clip(np.ceil((z - s.lowest) / s.slice_height), 0, _BITS - 1).astype(int)
        seen = np.zeros((s.rings, s.sectors, _BITS), bool)
        inside = ring < s.rings
        seen[ring[inside], sector[inside], height[inside]] = True
        return np.packbits(seen, axis=2, bitorder='little').astype(np.float32).ravel()

    def features(self, cloud: PointCloud) -> None:
        """Return None: there are no keypoints to register by."""

    def row(self, descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return what has to be stored of a descriptor; raises DataError on another length."""
        s = self.settings
        if descriptor.size != self.length:
            raise DataError(
                f'a {s.rings} x {s.sectors} LiDAR-Iris has {self.length} numbers, got '
                f'{descriptor.size}; was the map made with other settings?'
            )
        image = np.asarray(descriptor, np.float64).reshape(s.rings, s.sectors)
        # A row of one value has no response: its signs would be those of rounding errors.
        kept = np.ptp(image, axis=1) > 0
        answers = responses(image, s) * kept[:, None]
        found = answers.reshape(-1, s.sectors)
        bits = np.concatenate([found.real > 0, found.imag > 0])
        # Columns one after the other: turning the image is then moving along the words.
        packed = self._packed(bits.T), self._packed(np.tile(kept, 2 * s.scales)[None])
        size = np.abs(answers[s.turn_filter])
        phase = np.divide(answers[s.turn_filter], size, out=answers[0] * 0.0, where=size > 1e-9)
        spectrum = np.fft.fft(phase, axis=1)[:, 1 : 1 + self._frequencies].T.astype(np.complex64)
        numbers = np.ascontiguousarray(spectrum).view(np.float32).ravel()
        return np.concatenate([*(p.view(np.float32).ravel() for p in packed), numbers])

    def compare(
        self, query: NDArray[np.float32], rows: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Compare a query row with rows [N x row_length].

        Returns:
            distances [N] float32, share of bits that differ at the best turn, 1 where no bits can
            be compared; and yaw [N] float32, radians: heading of the query in the match.
        """
        s = self.settings
        bits, kept, phases = (part[0] for part in self._parts(query[None]))
        doubled = np.concatenate([bits, bits]).ravel()
        # Window number m of the query begins with its column m.
        windows = sliding_window_view(doubled, s.sectors * self._words)[:: self._words]
        distance = np.empty(len(rows), np.float32)
        shift = np.empty(len(rows), np.int64)
        for start in range(0, len(rows), _BATCH):
            part = slice(start, min(start + _BATCH, len(rows)))
            row_bits, row_kept, row_phases = self._parts(rows[part])
            turns = self._turns(phases, row_phases)
            # Rows that are blank in one image only: zeros against the other's ones, at any turn.
            blank = _count(row_bits & ~kept) + _count(bits & ~row_kept[:, None])
            differing = np.empty(turns.shape, np.int64)
            for column, turn in enumerate(turns.T):
                moved = windows[-turn % s.sectors].reshape(row_bits.shape)
                moved ^= row_bits
                differing[:, column] = _count(moved) - blank
            best = np.argmin(differing, axis=1)
            at = np.arange(len(best))
            total = s.sectors * _count(row_kept & kept)
            distance[part] = np.where(total > 0, differing[at, best] / np.maximum(total, 1), 1.0)
            shift[part] = turns[at, best]
        yaw = (shift * (2.0 * np.pi / s.sectors)).astype(np.float32)
        return distance, np.where(yaw > np.pi, yaw - np.float32(2.0 * np.pi), yaw)

    def _turns(
        self, query: NDArray[np.complex64], rows: NDArray[np.complex64]
    ) -> NDArray[np.int64]:
        """Return the turns [N x T] in sectors at which the query is compared with each row."""
        s = self.settings
        if s.peaks == 0:
            return np.tile(np.arange(s.sectors), (len(rows), 1))
        spectrum = np.zeros((len(rows), s.sectors // 2 + 1), np.complex64)
        spectrum[:, 1 : 1 + self._frequencies] = np.einsum('kfr,fr->kf', rows, np.conj(query))
        correlation = np.fft.irfft(spectrum, n=s.sectors, axis=1)
        around = np.arange(-s.turn_tolerance, s.turn_tolerance + 1)
        found = []
        for _ in range(s.peaks):
            turns = (np.argmax(correlation, axis=1)[:, None] + around) % s.sectors
            np.put_along_axis(correlation, turns, -np.inf, axis=1)
            found.append(turns)
        return np.concatenate(found, axis=1)

    def _packed(self, bits: NDArray[np.bool_]) -> NDArray[np.uint64]:
        """Return bits [N x features] as words [N x words]."""
        padded = np.zeros((len(bits), self._words * _WORD), bool)
        padded[:, : bits.shape[1]] = bits
        return np.packbits(padded, axis=1).view(np.uint64)

    def _parts(
        self, rows: NDArray[np.float32]
    ) -> tuple[NDArray[np.uint64], NDArray[np.uint64], NDArray[np.complex64]]:
        """Return bits [N x sectors x words], kept bits [N x words] and phases [N x F x rings]."""
        s, n = self.settings, len(rows)
        split = np.cumsum([2 * self._words * s.sectors, 2 * self._words])
        bits, kept, phases = (np.ascontiguousarray(part) for part in np.split(rows, split, axis=1))
        return (
            bits.view(np.uint64).reshape(n, s.sectors, self._words),
            kept.view(np.uint64),
            phases.view(np.complex64).reshape(n, self._frequencies, s.rings),
        )


def responses(image: NDArray[np.float64], settings: LidarIrisConfig) -> NDArray[np.complex128]:
    """Return the responses [scales x rings x sectors] of an image [rings x sectors]."""
    s = settings
    # Only positive frequencies pass: the imaginary part of a response is its quadrature.
    frequency = np.arange(1, s.sectors // 2 + 1) / s.sectors
    wavelengths = s.wavelength * s.growth ** np.arange(s.scales)
    gains = np.zeros((s.scales, 1, s.sectors))
    logarithm = np.log(frequency * wavelengths[:, None, None])
    gains[:, :, 1 : len(frequency) + 1] = np.exp(-(logarithm**2) / (2 * np.log(s.bandwidth) ** 2))
    return np.asarray(np.fft.ifft(np.fft.fft(image, axis=1) * gains, axis=2))


def _count(words: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Return the number of ones [N] in the words of each row [N x ...]."""
    # Sums of 32 bits are much faster than of 64, and large enough.
    ones = np.bitwise_count(words).reshape(len(words), -1).sum(axis=1, dtype=np.uint32)
    return ones.astype(np.int64)
