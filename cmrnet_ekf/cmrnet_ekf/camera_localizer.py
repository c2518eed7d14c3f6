"""Locate a camera in a LiDAR map: look, predict, look again from there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from bags.records import CameraModel
from cmrnet_ekf import euler
from cmrnet_ekf.lidar_image.framing import Framing
from cmrnet_ekf.lidar_image.imager import LidarImager
from cmrnet_ekf.lidar_image.settings import LidarImageConfig
from cmrnet_ekf.networks.config import CmrnetConfig
from cmrnet_ekf.pose_belief import PoseBelief
from cmrnet_ekf.pose_sampling import T_OPTICAL_BODY
from cmrnet_ekf.predictors import Predictor
from lcd_common import se3
from lcd_common.errors import ConfigError

Pixels = NDArray[np.uint8]
# A guess is in a stage's range when so many of its deviations are.
_COVERED = 2.0


@dataclass(frozen=True)
class PoseEstimate:
    """Where the vehicle is, by one image.

    Attributes:
        T_map_base: refined pose.
        covariance: 6x6, body axes of base, translation first; zeros of a network that does not
            know, infinite where a predictive variance is.
        belief: the last network's, per axis: T_guess_camera with axes forward, left, up.
        T_map_guess: from where the last network looked, base frame.
        lidar: [H x W] what it saw of the map, metres.
        fill: share of that image's pixels that show the map.
    """

    T_map_base: se3.Array
    covariance: se3.Array
    belief: PoseBelief
    T_map_guess: se3.Array
    lidar: torch.Tensor
    fill: float


class CameraLocalizer:
    """Refine guesses of the vehicle's pose by images, one network after the other."""

    def __init__(
        self, camera: CameraModel, T_base_camera: se3.Array, stages: Sequence[Predictor]
    ) -> None:
        """Prepare for a camera.

        Args:
            camera: calibration of the images.
            T_base_camera: where the camera's optical frame sits on the vehicle.
            stages: networks for ever smaller errors; often one.

        Raises:
            ConfigError: there are no stages, or they do not see the same images.
        """
        if not stages:
            raise ConfigError('expected at least one stage')
        if len({p.settings.images for p in stages}) > 1:
            raise ConfigError('the stages must see the same images')
        self.framing = framing_of(camera, stages[0].settings)
        self.stages = tuple(stages)
        self._T_base_body = T_base_camera @ T_OPTICAL_BODY
        self._imagers = [imager_of(self.framing.camera, p.settings, p.device) for p in stages]

    def first_stage(self, covariance: se3.Array) -> int:
        """Return the last stage that can refine a guess at once; 0 when the guess is not so sure.

        Args:
            covariance: 6x6 of the guess, translation first; two deviations must lie within what
                the stage was trained for.
        """
        metres, radians = (
            _COVERED * float(np.sqrt(np.linalg.eigvalsh(block)[-1]))
            for block in (covariance[:3, :3], covariance[3:, 3:])
        )
        for stage in range(len(self.stages) - 1, 0, -1):
            of = self.stages[stage].trained_for
            if of is not None and metres <= of.translation_m and radians <= of.rotation_rad:
                return stage
        return 0

    def locate(
        self,
        pixels: Pixels,
        points: NDArray[np.float32] | torch.Tensor,
        T_map_guess: se3.Array,
        first: int = 0,
    ) -> PoseEstimate:
        """Return the pose by one image.

        Args:
            pixels: [H x W] or [H x W x 3] of the camera.
            points: [N x 3] float32 of the map around the guess, map frame. With large coordinates
                shift map and guess so that the vehicle is near the origin.
            T_map_guess: pose of base that is about right.
            first: stage to begin with; see `first_stage`.
        """
        return self.locate_framed(self.framing.image(pixels), points, T_map_guess, first)

    def locate_framed(
        self,
        framed: Pixels,
        points: NDArray[np.float32] | torch.Tensor,
        T_map_guess: se3.Array,
        first: int = 0,
    ) -> PoseEstimate:
        """Return the pose by an image that has been through `framing` before; see `locate`."""
        image = torch.from_numpy(framed).permute(2, 0, 1)[None]
        T_map_body = T_map_guess @ self._T_base_body
        for predictor, imager in zip(self.stages[first:], self._imagers[first:], strict=True):
            T_map_looked = T_map_body
            lidar = imager.image(points, T_OPTICAL_BODY @ se3.inverse(T_map_looked))
            belief = predictor.belief(image, lidar[None])
            T_map_body = T_map_looked @ belief.transforms[0]
        T_body_base = se3.inverse(self._T_base_body)
        return PoseEstimate(
            T_map_body @ T_body_base,
            base_covariance(belief, T_body_base),
            belief,
            T_map_looked @ T_body_base,
            lidar,
            float((lidar > 0).float().mean()),
        )

    def view(
        self, points: NDArray[np.float32] | torch.Tensor, T_map_base: se3.Array
    ) -> torch.Tensor:
        """Return the LiDAR image [H x W], metres, as the last stage sees it from a pose."""
        T_map_body = T_map_base @ self._T_base_body
        return self._imagers[-1].image(points, T_OPTICAL_BODY @ se3.inverse(T_map_body))


def base_covariance(belief: PoseBelief, T_body_base: se3.Array) -> se3.Array:
    """Return the covariance of T_map_base, body axes of base, of a belief of one pose."""
    covariance = belief.covariance[0]
    if not np.isfinite(covariance).all():
        return np.full((6, 6), np.inf)
    J = se3.adjoint(se3.inverse(T_body_base)) @ euler.jacobian_to_body(belief.mean[0])
    out = J @ covariance @ J.T
    return np.asarray(0.5 * (out + out.T), np.float64)


def framing_of(camera: CameraModel, s: CmrnetConfig) -> Framing:
    """Return how a network wants the images of a camera."""
    return Framing(camera, s.width, s.height, focal=s.focal, centred=s.centred)


def imager_of(
    camera: CameraModel, s: CmrnetConfig, device: torch.device | str = 'cpu'
) -> LidarImager:
    """Return what makes a network's LiDAR images; `camera` is that of its images."""
    settings = LidarImageConfig(
        max_depth=s.max_depth, radius=s.occlusion_radius, threshold=s.occlusion_threshold
    )
    return LidarImager(camera, settings, device)
