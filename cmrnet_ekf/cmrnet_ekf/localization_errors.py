"""Tell how far off poses are, as Tables 5.1 and 5.4 do."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from lcd_common import se3
from lcd_common.se3 import Array


@dataclass(frozen=True)
class LocalizationErrors:
    """Summary of errors: metres, degrees, and shares of failures."""

    count: int
    t_median_m: float
    t_mean_m: float
    t_std_m: float
    t_p95_m: float
    r_median_deg: float
    r_mean_deg: float
    r_std_deg: float
    r_p95_deg: float
    failures_1m: float
    failures_4m: float


def pose_errors(T_one: Array, T_other: Array) -> tuple[Array, Array]:
    """Return distances [N], metres, and angles [N], radians, between poses [N x 4 x 4]."""
    difference = se3.inverse(T_one) @ T_other
    angle = Rotation.from_matrix(difference[:, :3, :3]).magnitude()
    return np.linalg.norm(difference[:, :3, 3], axis=1), np.asarray(angle, np.float64)


def summary(metres: Array, radians: Array) -> LocalizationErrors:
    """Return the summary of errors [N]."""
    degrees = np.rad2deg(radians)
    return LocalizationErrors(
        len(metres),
        *_four(metres),
        *_four(degrees),
        float((metres > 1.0).mean()),
        float((metres > 4.0).mean()),
    )


def _four(values: Array) -> tuple[float, float, float, float]:
    return (
        float(np.median(values)),
        float(values.mean()),
        float(values.std()),
        float(np.percentile(values, 95)),
    )
