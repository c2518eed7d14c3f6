"""Take the errors that CMRNet made in closed loop, and judge the filter that lived with them."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cmrnet_ekf.ekf.consistency import anees, autocorrelation
from lcd_common import se3

_STARTING = 20  # images in which a wrong start is taken away
_STRETCH = 80  # images: eight seconds, so that a few kilometres make fifty of them
GROUP = 50  # runs that a band is for


@dataclass(frozen=True)
class CameraErrors:
    """Errors of a real camera localization, in place of simulated ones.

    Attributes:
        xi: [stretches x N x 6], T_true = T_observed exp(xi), in the order in which they came.
        covariances: [stretches x N x 6 x 6] that came with them.
        nees: [stretches x N] of the filter that they came to.
        correlation_s: what the filter is told of their correlation.
    """

    xi: se3.Array
    covariances: se3.Array
    nees: se3.Array
    correlation_s: float = 0.0


def camera_errors(files: Sequence[Path], way: str = 'der') -> CameraErrors | None:
    """Return the errors of a way of the closed loop; None when it has not been driven.

    Runs are cut into stretches of eight seconds. Those of the first seeds come first: no two of
    one seed are of the same part of a drive.
    """
    parts: list[tuple[int, se3.Array, se3.Array, se3.Array]] = []
    for path in files:
        if not path.is_file():
            continue
        with np.load(path, allow_pickle=False) as kept:
            for name in kept.files:
                run, _, what = name.rpartition('_')
                if what != 'xi' or run.rpartition('_')[0] != way:
                    continue
                arrays = (kept[name], kept[f'{run}_covariance'], kept[f'{run}_nees'])
                # An image that was skipped has no observation: the filter's pose has.
                count = min(map(len, arrays))
                for at in range(_STARTING, count - _STRETCH + 1, _STRETCH):
                    xi, C, own = (array[at : at + _STRETCH] for array in arrays)
                    parts.append((int(run.rpartition('_')[2]), xi, C, own))
    if not parts:
        return None
    parts.sort(key=lambda part: part[0])
    _, xi, C, own = zip(*parts, strict=True)
    return CameraErrors(np.array(xi), np.array(C), np.array(own))


def in_closed_loop(camera: CameraErrors) -> dict[str, Any]:
    """Return how consistent the filter of the closed loop was over fifty stretches.

    Beside it what came from the camera: NEES of its observations, and how long errors last.
    """
    xi, C = camera.xi.reshape(-1, 6), camera.covariances.reshape(-1, 6, 6)
    root = np.linalg.cholesky(C)
    whitened = np.linalg.solve(root, xi[..., None])[..., 0]
    own = np.square(whitened).sum(1)
    runs = list(whitened.reshape(*camera.xi.shape[:2], 6))
    group = anees(camera.nees[:GROUP])
    return {
        'stretches': len(camera.nees[:GROUP]),
        'stretch_images': _STRETCH,
        'anees_inside_share': group.inside_share,
        'anees_mean': group.mean,
        'nees_of_observations_mean': float(own.mean()),
        'nees_of_observations_median': float(np.median(own)),
        'autocorrelation_of_observations': {
            f'{lag / 10:g}_s': autocorrelation(runs, lag) for lag in (1, 5, 10, 20, 40)
        },
    }
