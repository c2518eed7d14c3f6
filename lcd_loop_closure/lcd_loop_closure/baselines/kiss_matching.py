"""Register clouds by KISS-Matcher, which stands in for TEASER++ among the thesis's baselines.

Lim et al., "KISS-Matcher: Fast and Robust Point Cloud Registration Revisited", ICRA 2025. The
package is no part of the suite's installation.
"""

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import LocalizationError
from lcd_common.settings import config, setting


class MissingPackageError(LocalizationError):
    """A baseline needs a package that is not installed."""


@config
class KissMatcherConfig:
    """What KISS-Matcher is given; everything else keeps the package's defaults."""

    voxel_size: float = setting(0.5, 'thinning of both clouds', unit='m', low=0.05)
    min_inliers: int = setting(
        5, 'matches that must agree in the end; below, its authors call it a failure', low=0
    )


class KissMatcher:
    """Register by features, pruned in a graph of compatible matches and solved robustly."""

    name = 'kiss_matcher'

    def __init__(self, settings: KissMatcherConfig | None = None) -> None:
        """Find the package.

        Raises:
            MissingPackageError: it is not installed.
        """
        self.settings = settings or KissMatcherConfig()
        try:
            self._package: Any = importlib.import_module('kiss_matcher')
        except ImportError:
            raise MissingPackageError(
                'the baseline kiss_matcher needs the package kiss-matcher: '
                'pip install kiss-matcher==1.0.2'
            ) from None

    def prepare(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the finite points [N x 3]; the package makes features of both clouds at once."""
        return cloud.finite().xyz

    def register(self, match: NDArray[np.float32], query: NDArray[np.float32]) -> se3.Array | None:
        """Return T_match_query; None where it finds no solution or too few matches agree."""
        config = self._package.KISSMatcherConfig(self.settings.voxel_size)
        matcher = self._package.KISSMatcher(config)
        return self._answer(matcher, matcher.estimate(query, match))

    def solve(self, query: NDArray[np.float32], match: NDArray[np.float32]) -> se3.Array | None:
        """Return T_match_query of matched points [N x 3], most of which may be wrong."""
        config = self._package.KISSMatcherConfig(self.settings.voxel_size)
        matcher = self._package.KISSMatcher(config)
        return self._answer(matcher, matcher.prune_and_solve(query, match))

    def _answer(self, matcher: Any, solution: Any) -> se3.Array | None:
        s = self.settings
        if not solution.valid or matcher.get_num_final_inliers() < s.min_inliers:
            return None
        return se3.from_rotation_translation(
            np.asarray(solution.rotation, np.float64),
            np.asarray(solution.translation, np.float64).ravel(),
        )
