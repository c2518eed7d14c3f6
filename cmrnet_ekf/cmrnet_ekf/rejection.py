"""Reject predictions that are too uncertain (thesis section 5.3.6)."""

import numpy as np
from numpy.typing import NDArray

from cmrnet_ekf.pose_belief import PoseBelief
from lcd_common.se3 import Array


def traces(belief: PoseBelief) -> Array:
    """Return the traces [N x 2] of the covariances of translation and of rotation."""
    variance = belief.variance
    return np.stack([variance[:, :3].sum(1), variance[:, 3:].sum(1)], 1)


def accepted(
    traces_: Array, share: float = 0.15, thresholds: Array | None = None
) -> NDArray[np.bool_]:
    """Tell [N] which predictions are kept: neither trace lies in its top share.

    Args:
        traces_: [N x 2].
        share: the top of each trace that is discarded.
        thresholds: [2] fixed beforehand; None: from these traces, as the thesis does.
    """
    if thresholds is None:
        thresholds = rejection_thresholds(traces_, share)
    return np.asarray((traces_ <= thresholds).all(1))


def rejection_thresholds(traces_: Array, share: float = 0.15) -> Array:
    """Return the traces [2] above which the top share lies."""
    kept = max(int(np.ceil((1.0 - share) * len(traces_))), 1)
    return np.asarray(np.sort(traces_, axis=0)[kept - 1], np.float64)
