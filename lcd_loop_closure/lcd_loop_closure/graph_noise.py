"""Say how far a measurement between two poses can be trusted.

Registration's covariance knows the noise of one alignment and nothing of what stays the same from
scan to scan (calibration, deskewing, the map's own drift), so that chains of it are too sure. Both
models below therefore add a floor. GTSAM orders a Pose3's tangent rotation first; the reordering is
done here and nowhere else in the graph.
"""

import gtsam
import numpy as np

from lcd_common import se3
from lcd_common.settings import config, setting


@config
class GraphNoiseConfig:
    """Noise of the factors, where their source does not say and beneath what it says."""

    odometry_translation: float = setting(
        0.02, 'translation noise of odometry that gives no covariance', unit='m/sqrt(m)', low=1e-6
    )
    odometry_rotation: float = setting(
        1e-3, 'rotation noise of odometry that gives no covariance', unit='rad/sqrt(m)', low=1e-9
    )
    odometry_turn: float = setting(
        5e-3, 'further rotation noise, by the angle turned', unit='rad/sqrt(rad)', low=0.0
    )
    odometry_translation_floor: float = setting(
        0.01, 'added to the covariance of each odometry link (root)', unit='m', low=1e-6
    )
    odometry_rotation_floor: float = setting(
        5e-4, 'added to the covariance of each odometry link (root)', unit='rad', low=1e-9
    )
    loop_translation_floor: float = setting(
        0.05, 'added to the covariance of each loop (root)', unit='m', low=1e-6
    )
    loop_rotation_floor: float = setting(
        5e-3, 'added to the covariance of each loop (root)', unit='rad', low=1e-9
    )
    loop_translation: float = setting(
        0.1, 'translation noise of a loop that gives no covariance', unit='m', low=1e-6
    )
    loop_rotation: float = setting(
        1e-2, 'rotation noise of a loop that gives no covariance', unit='rad', low=1e-9
    )


class GraphNoise:
    """Give each measurement of a graph its 6x6 covariance (body axes, translation first)."""

    def __init__(self, settings: GraphNoiseConfig) -> None:
        self.settings = settings
        self._odometry_floor = diagonal(
            settings.odometry_translation_floor, settings.odometry_rotation_floor
        )
        self._loop_floor = diagonal(settings.loop_translation_floor, settings.loop_rotation_floor)

    def odometry(self, T_previous_this: se3.Array, covariance: se3.Array | None) -> se3.Array:
        """Return the covariance of a link: the given one, or one that grows with the motion.

        Without a given one its variance grows linearly with the distance, as of a random walk; the
        defaults make 0.5 m in 100 m, KISS-ICP's drift on KITTI.
        """
        if covariance is None or not se3.is_covariance(covariance):
            s = self.settings
            metres, radians = se3.distance(np.eye(4), T_previous_this)
            turned = s.odometry_rotation**2 * metres + s.odometry_turn**2 * radians
            covariance = diagonal(s.odometry_translation * np.sqrt(metres), np.sqrt(turned))
        return covariance + self._odometry_floor

    def loop(self, covariance: se3.Array | None) -> se3.Array:
        """Return the covariance of a loop: the given one or the configured one, plus the floor."""
        if covariance is None or not se3.is_covariance(covariance):
            covariance = diagonal(self.settings.loop_translation, self.settings.loop_rotation)
        return covariance + self._loop_floor


def diagonal(translation: float, rotation: float) -> se3.Array:
    """Return a 6x6 covariance of two standard deviations, metres and radians."""
    return np.diag(np.repeat([translation**2, rotation**2], 3))


# What an odometry link says that was found to be broken: next to nothing.
BROKEN_LINK = diagonal(30.0, 3.0)


def gaussian(covariance: se3.Array) -> gtsam.noiseModel.Gaussian:
    """Return GTSAM's noise model of a translation-first covariance."""
    return gtsam.noiseModel.Gaussian.Covariance(se3.gtsam_covariance(covariance))


def gauge(*, free: bool = False, level: bool = False) -> gtsam.noiseModel.Gaussian:
    """Return the noise of the first pose.

    It is fixed; free where satellites say where the map lies; `level` leaves roll and pitch to
    gravity.
    """
    if free:
        return gaussian(diagonal(10.0, 0.5))
    return gaussian(
        np.diag(np.square([1e-3, 1e-3, 1e-3, *([0.1, 0.1] if level else [1e-3] * 2), 1e-3]))
    )


def between(
    first: int, second: int, T_first_second: se3.Array, noise: gtsam.noiseModel.Base
) -> gtsam.BetweenFactorPose3:
    """Return the factor of a measured relative pose."""
    return gtsam.BetweenFactorPose3(first, second, gtsam.Pose3(T_first_second), noise)
