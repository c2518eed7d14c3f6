"""Keypoints of a sweep and what the network says of them: what registers a keyframe later."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common.errors import DataError


@dataclass(frozen=True)
class LocalFeatures:
    """Keypoints with their features.

    Attributes:
        keypoints: [N x 3] float32, base frame, metres.
        values: [N x D] float16.
    """

    keypoints: NDArray[np.float32]
    values: NDArray[np.float16]

    def __post_init__(self) -> None:
        if self.keypoints.ndim != 2 or self.keypoints.shape[1] != 3:
            raise DataError(f'keypoints must have the shape N x 3, got {self.keypoints.shape}')
        if self.values.ndim != 2 or len(self.values) != len(self.keypoints):
            raise DataError(
                f'{len(self.keypoints)} keypoints need as many rows of features, '
                f'got the shape {self.values.shape}'
            )

    def __len__(self) -> int:
        return len(self.keypoints)

    @property
    def nbytes(self) -> int:
        """Size in memory, bytes."""
        return self.keypoints.nbytes + self.values.nbytes
