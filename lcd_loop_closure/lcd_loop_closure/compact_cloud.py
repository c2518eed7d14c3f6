"""Keep a keyframe's cloud in a quarter of the memory, in the node and on disk alike."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError

_STEPS = 32767  # largest int16


@dataclass(frozen=True)
class CompactCloud:
    """Points of one keyframe in its base frame, 6 bytes each (8 with intensity).

    Attributes:
        steps: [N x 3] int16; times `step_m` are metres.
        step_m: resolution, chosen so that the farthest coordinate just fits: 2.5 mm for 80 m. A
            float16 would be as small but round a point at 80 m by up to 31 mm.
        intensity: [N] float16, or None where the sensor gives none.
    """

    steps: NDArray[np.int16]
    step_m: float
    intensity: NDArray[np.float16] | None = None

    def __post_init__(self) -> None:
        if self.steps.ndim != 2 or self.steps.shape[1] != 3 or self.steps.dtype != np.int16:
            raise DataError(
                f'a compact cloud must be N x 3 int16, got {self.steps.shape} {self.steps.dtype}'
            )
        if not np.isfinite(self.step_m) or self.step_m <= 0:
            raise DataError(f'the step of a compact cloud must be positive, got {self.step_m}')
        if self.intensity is not None and self.intensity.shape != (len(self.steps),):
            raise DataError(
                f'intensity must have one value for each of the {len(self.steps)} points, '
                f'got the shape {self.intensity.shape}'
            )

    def __len__(self) -> int:
        return len(self.steps)

    @property
    def nbytes(self) -> int:
        """Size in memory, bytes."""
        return self.steps.nbytes + (0 if self.intensity is None else self.intensity.nbytes)

    def xyz(self) -> NDArray[np.float32]:
        """Return the points [N x 3] in metres."""
        return self.steps * np.float32(self.step_m)

    def cloud(self) -> PointCloud:
        """Return the points as a PointCloud."""
        intensity = None if self.intensity is None else self.intensity.astype(np.float32)
        return PointCloud(self.xyz(), intensity)


def compact(cloud: PointCloud) -> CompactCloud:
    """Compact a cloud; points that are not finite are left out, point times are not kept."""
    cloud = cloud.finite()
    farthest = float(np.abs(cloud.xyz).max()) if len(cloud) else 0.0
    step_m = max(farthest, 1e-3) / _STEPS
    steps = np.rint(cloud.xyz / np.float64(step_m)).astype(np.int16)
    intensity = None
    if cloud.intensity is not None:
        largest = float(np.finfo(np.float16).max)
        intensity = np.clip(cloud.intensity, -largest, largest).astype(np.float16)
    return CompactCloud(steps, step_m, intensity)
