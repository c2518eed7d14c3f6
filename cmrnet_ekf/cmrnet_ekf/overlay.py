"""Show how well the map fits an image: coloured points over a darkened picture."""

import numpy as np
from numpy.typing import NDArray

Pixels = NDArray[np.uint8]
_NEAREST_M, _FARTHEST_M = 4.0, 60.0
# Red is near, then yellow, green and blue far away.
_COLOURS = np.array([[255, 40, 20], [255, 200, 0], [60, 220, 60], [0, 170, 220], [60, 60, 200]])


def overlay(image: Pixels, depth: NDArray[np.float32]) -> Pixels:
    """Return an image [H x W x 3] with the depths [H x W], metres, over it; 0 is no point."""
    out = (image * 0.7).astype(np.uint8)
    seen = depth > 0
    out[seen] = colours(depth[seen])
    return out


def colours(depth: NDArray[np.float32]) -> Pixels:
    """Return the colours [N x 3] of depths [N], by their logarithm."""
    share = np.log(np.maximum(depth, 1e-3) / _NEAREST_M) / np.log(_FARTHEST_M / _NEAREST_M)
    at = np.clip(share, 0.0, 1.0) * (len(_COLOURS) - 1)
    grid = np.arange(len(_COLOURS))
    return np.stack([np.interp(at, grid, _COLOURS[:, k]) for k in range(3)], 1).astype(np.uint8)
