"""Hold a known place, and the answer to "which known place is this?"."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3


@dataclass(frozen=True)
class Place:
    """A place of the map.

    Attributes:
        id: number of the place; with keyframes, that of the keyframe.
        stamp_ns: when it was seen.
        T_map_base: where the vehicle stood, metres.
        covariance: 6x6 of T_map_base, body axes, translation first; None when unknown.
    """

    id: int
    stamp_ns: int
    T_map_base: se3.Array
    covariance: se3.Array | None = None


@dataclass(frozen=True)
class Match:
    """A known place that looks like the scan.

    Attributes:
        place_id: of the place.
        T_map_base: pose of the place, metres: the scan was taken near it, in whatever heading.
        covariance: 6x6 of the scan's pose around it, body axes, translation first: how far a match
            may be away, and how uncertain the place's own pose is.
        similarity: cosine of the descriptors, -1..1 (thesis equation 22).
        distance: Euclidean distance of the descriptors.
        false_match_probability: 0..1, that the place is another; None when nothing is calibrated,
            and of all but the best match.
        accepted: it may be believed; only ever true of the best match, and while the guarantee
            stands.
    """

    place_id: int
    T_map_base: se3.Array
    covariance: se3.Array
    similarity: float
    distance: float
    false_match_probability: float | None = None
    accepted: bool = False


@dataclass(frozen=True)
class Judgement:
    """How far the best match can be believed.

    Attributes:
        false_match_probability: 0..1; None when nothing is calibrated.
        accepted: the probability is below the calibrated threshold, and the guarantee stands.
        withdrawn: why the guarantee does not stand, one sentence; None while it does.
    """

    false_match_probability: float | None
    accepted: bool
    withdrawn: str | None


@dataclass(frozen=True)
class PlaceAnswer:
    """What the map knows about one scan.

    Attributes:
        matches: best first; empty when nothing in the map may be answered yet.
        uncertainty: u_EV, the sum of the features' variances over the members (thesis equation 23);
            unit of squared features.
        uncertainty_normalised: divided by the squared norm of the mean descriptor.
        variances: [D] of each feature.
        database_size: places that were searched.
        withdrawn: why accepted or not carries no guarantee; None while it does.
    """

    matches: tuple[Match, ...]
    uncertainty: float
    uncertainty_normalised: float
    variances: NDArray[np.float64]
    database_size: int
    withdrawn: str | None

    @property
    def best(self) -> Match | None:
        """The most similar place; None when there is none."""
        return self.matches[0] if self.matches else None
