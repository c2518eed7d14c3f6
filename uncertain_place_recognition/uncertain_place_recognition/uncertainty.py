"""Say how far the members of an ensemble disagree about one place (thesis equations 19 and 23)."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lcd_common.errors import DataError


def mean_descriptor(members: ArrayLike) -> NDArray[np.float32]:
    """Return the mean [... x D] of member embeddings [... x M x D] (equation 19)."""
    return _members(members).mean(-2).astype(np.float32)


def feature_variance(members: ArrayLike) -> NDArray[np.float64]:
    """Return the variance [... x D] of every feature over members [... x M x D] (equation 19).

    Divided by M, not by M - 1, as the thesis has it: one member has no variance.
    """
    return _members(members).var(-2)


def total_uncertainty(members: ArrayLike, normalised: bool = True) -> NDArray[np.float64]:
    """Return u_EV [...], the sum of the features' variances (equation 23).

    Args:
        members: embeddings [... x M x D] of one input.
        normalised: divide by the squared norm of the mean. Descriptors of these networks have no
            fixed length, and the plain sum grows with its square whatever the members agree on.
            Between 0 (all alike) and infinity; a mean of zero counts as infinitely uncertain.
    """
    whole = _members(members)
    total: NDArray[np.float64] = whole.var(-2).sum(-1)
    if not normalised:
        return total
    squared = np.square(whole.mean(-2)).sum(-1)
    return np.divide(total, squared, out=np.full_like(total, np.inf), where=squared > 0.0)


def unit_uncertainty(members: ArrayLike) -> NDArray[np.float64]:
    """Return the sum of variances [...] of members scaled to unit length: directions alone.

    It is 1 - |mean direction|^2, between 0 and 1: what cosine similarity (22) can see.
    """
    whole = _members(members)
    norms = np.linalg.norm(whole, axis=-1, keepdims=True)
    units = np.divide(whole, norms, out=np.zeros_like(whole), where=norms > 0.0)
    return units.var(-2).sum(-1)


def _members(members: ArrayLike) -> NDArray[np.float64]:
    whole = np.asarray(members, np.float64)
    if whole.ndim < 2 or not whole.shape[-2]:
        raise DataError(f'expected member embeddings [... x M x D], got the shape {whole.shape}')
    return whole
