"""Say whether several places look like the query, which no ensemble can see of the query alone."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcd_common.errors import DataError
from lcd_common.settings import config, setting


@config
class AmbiguityConfig:
    """Which matches count, and how soon a worse one counts less."""

    matches: int = setting(10, 'matches that are looked at', low=2)
    sharpness: float = setting(
        20.0, 'a match whose distance is 1/sharpness above the best counts 1/e', low=0.01
    )
    cap: float = setting(500.0, 'deviation from which a match counts no more', unit='m', low=1.0)
    same_place: float = setting(25.0, 'matches nearer to the best are its place', unit='m', low=0.0)


def match_spread(
    distance: ArrayLike, positions: ArrayLike, settings: AmbiguityConfig | None = None
) -> NDArray[np.float64]:
    """Return how far the best matches lie apart [...], metres: the spread of SUE.

    Zaffar et al., "On the Estimation of Image-matching Uncertainty in Visual Place Recognition",
    CVPR 2024: the standard deviation of the matches' positions, weighted by their descriptors'
    distances. Two things differ from the released code: deviations are cut off at both sides (there
    a match 2 km to the south counts fully, one to the north as 500 m), and weights fall with the
    distance relative to that of the best match, because descriptors of other networks have other
    scales.

    Args:
        distance: [... x K] of the descriptors, best first, at least 0.
        positions: [... x K x 2] of the matches, metres.
        settings: which matches count.
    """
    s = settings or AmbiguityConfig()
    apart, where = _matches(distance, positions, s.matches)
    weight = np.exp(-s.sharpness * (_relative(apart) - 1.0))
    weight /= weight.sum(-1, keepdims=True)
    mean = (weight[..., None] * where).sum(-2, keepdims=True)
    deviation = np.clip(where - mean, -s.cap, s.cap)
    # SUE takes the mean of the two axes' variances.
    return np.sqrt((weight[..., None] * np.square(deviation)).sum((-2, -1)) / 2.0)


def second_place_ratio(
    distance: ArrayLike, positions: ArrayLike, settings: AmbiguityConfig | None = None
) -> NDArray[np.float64]:
    """Return the best distance over that of the best other place [...]: 1 is a toss-up.

    It is 0 when all matches are of one place: no other came near. (The PA score of visual place
    recognition takes the second match, which in a dense map is the same place.)
    """
    s = settings or AmbiguityConfig()
    apart, where = _matches(distance, positions, s.matches)
    other = np.linalg.norm(where - where[..., :1, :], axis=-1) > s.same_place
    rival = np.where(other, apart, np.inf).min(-1)
    best = apart[..., 0]
    ratio = np.divide(best, rival, out=np.ones_like(best), where=rival > 0.0)
    return np.clip(ratio, 0.0, 1.0)


def _relative(apart: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return distances over the best; where that is 0, others are infinitely worse."""
    best = apart[..., :1]
    same = apart <= best
    return np.where(
        same, 1.0, np.divide(apart, best, out=np.full_like(apart, np.inf), where=best > 0.0)
    )


def _matches(
    distance: ArrayLike, positions: ArrayLike, count: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    apart = np.asarray(distance, np.float64)
    where = np.asarray(positions, np.float64)
    if apart.ndim < 1 or not apart.shape[-1] or where.shape != (*apart.shape, 2):
        raise DataError(
            f'expected distances [... x K] and positions [... x K x 2], got the shapes '
            f'{apart.shape} and {where.shape}'
        )
    return np.maximum(apart[..., :count], 0.0), where[..., :count, :]
