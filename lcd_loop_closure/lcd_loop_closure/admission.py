"""Decide whether a loop may enter the graph before any solver has judged it."""

from collections.abc import Callable

import numpy as np
from scipy.stats import chi2

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_loop_closure.graph_snapshot import GraphLoop


@config
class PoseGraphConfig:
    """When loops enter the graph and how a verdict is carried in."""

    admission_probability: float = setting(
        0.9999, 'share of true loops that agree with the estimate', low=0.5, high=0.9999999
    )
    admission_distance: float = setting(
        10.0, 'loops that ask for a larger shift wait for the solver', unit='m', low=0.0
    )
    admission_angle: float = setting(
        0.35, 'loops that ask for a larger turn wait for the solver', unit='rad', low=0.0
    )
    kernel: float = setting(
        3.0, 'width of the Cauchy kernel of a loop not yet judged, in sigmas', low=0.1
    )
    rebuild_distance: float = setting(
        1.0,
        'a verdict that moves a pose farther rebuilds iSAM2 around its poses',
        unit='m',
        low=0.0,
    )


class Admission:
    """Compare loops with the estimate, under the covariance that it has at that moment."""

    def __init__(self, settings: PoseGraphConfig) -> None:
        self.settings = settings
        self._limit = float(np.sqrt(chi2.ppf(settings.admission_probability, 6)))

    def objection(
        self, loop: GraphLoop, T_match_query: se3.Array, covariance: Callable[[], se3.Array]
    ) -> tuple[float, str]:
        """Return by how many metres a loop differs from the estimate, and why it may not enter.

        Args:
            loop: the loop.
            T_match_query: the same transform as the graph estimates it.
            covariance: returns its 6x6, body axes of the query, translation first. Only asked for
                where the loop's own covariance does not explain the difference alone: that of two
                poses far apart in a large graph takes long, and could only explain more.
        """
        error = se3.log(se3.inverse(loop.T_match_query) @ T_match_query)
        sigmas = _sigmas(error, loop.covariance)
        if sigmas > self._limit:
            sigmas = _sigmas(error, covariance() + loop.covariance)
        metres, radians = float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))
        if sigmas > self._limit:
            return metres, (
                f'contradicts the estimate by {sigmas:.1f} sigma (limit {self._limit:.1f})'
            )
        s = self.settings
        if metres > s.admission_distance or radians > s.admission_angle:
            return metres, f'asks for a shift of {metres:.1f} m and {radians:.2f} rad'
        return metres, ''


def _sigmas(error: se3.Array, covariance: se3.Array) -> float:
    return float(np.sqrt(error @ np.linalg.solve(covariance, error)))
