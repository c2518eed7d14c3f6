"""Track a vehicle in closed loop: what it looks from is what the filter predicted.

Thesis section 5.3.7 and Algorithm 2. No satellites; the start pose is wrong.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cmrnet_ekf import euler
from cmrnet_ekf.camera_localizer import CameraLocalizer
from cmrnet_ekf.evaluation.tracking_drive import TrackingDrive
from cmrnet_ekf.evaluation.tracking_filters import (
    ThesisTracking,
    VehicleTracking,
    VehicleTrackingConfig,
)
from cmrnet_ekf.localization_errors import pose_errors
from cmrnet_ekf.mapping.local_map import LocalMap, near_origin
from cmrnet_ekf.pose_sampling import STAGES
from cmrnet_ekf.predictors import Predictor
from lcd_common import se3
from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting

THESIS, VEHICLE, UNFILTERED = 'thesis', 'vehicle', 'unfiltered'
_LOST_M = 4.0  # about where nothing of a guess of the first stage's range is left


@config
class TrackingConfig:
    """How wrong starts and wheels are, and what counts as seeing the map."""

    start_translation: float = setting(
        STAGES[0].translation_m, 'start poses are off by at most this, each axis', unit='m', low=0.0
    )
    start_rotation: float = setting(
        STAGES[0].rotation_rad, 'the same about each axis', unit='rad', low=0.0
    )
    speed_scale: float = setting(0.01, 'deviation of the factor by which wheels err', low=0.0)
    speed_noise: float = setting(
        0.1, 'deviation of the speed between two images', unit='m/s', low=0.0
    )
    least_fill: float = setting(
        0.02, 'share of pixels that must show the map; else the motion alone counts', low=0, high=1
    )


@dataclass(frozen=True)
class Track:
    """How far off one run was, at every image after the start.

    Attributes:
        seed: of the start and of the wheels' noise.
        T_map_base: [F x 4 x 4] of the filter.
        metres, radians: [F] errors.
        nees: [F] normalised estimation errors squared of the filter's poses, 6 when it is right.
        xi: [M x 6] T_true = T_observed exp(xi) of the camera's observations, as they came.
        covariances: [M x 6 x 6] that came with them, body axes; zero of a network that does not
            know.
        skipped: images whose observation could not be used.
    """

    seed: int
    T_map_base: se3.Array
    metres: se3.Array
    radians: se3.Array
    nees: se3.Array
    xi: se3.Array
    covariances: se3.Array
    skipped: int

    @property
    def diverged(self) -> bool:
        """Whether the vehicle was lost at the end: the median of the last tenth is above 4 m."""
        last = self.metres[-max(len(self.metres) // 10, 1) :]
        return bool(np.median(last) > _LOST_M)


def track(
    drive: TrackingDrive,
    local_map: LocalMap | None,
    stages: Sequence[Predictor],
    seed: int,
    *,
    by: str = THESIS,
    settings: TrackingConfig | None = None,
    told: VehicleTrackingConfig | None = None,
    progress: Callable[[], object] = lambda: None,
) -> Track:
    """Drive once.

    Args:
        drive: to follow.
        local_map: of where it goes.
        stages: networks; none: the motion model alone.
        seed: of start pose and wheels.
        by: the thesis's EKF, the vehicle's, or none: the camera's pose replaces the state.
        settings: of starts and wheels.
        told: what the vehicle's EKF is told of its inputs.
        progress: called after each image.

    Raises:
        ConfigError: the networks take other images than the drive was recorded for, or the filter
            is given a network that does not say how sure it is, or the vehicle's EKF a drive
            without inertial samples.
    """
    s, filtered = settings or TrackingConfig(), by != UNFILTERED
    localizer = None
    if stages:
        if any(tuple(p.settings.images) != drive.images for p in stages) or local_map is None:
            raise ConfigError(
                f'{drive.name} was recorded for images {drive.images}; the networks take '
                f'{tuple(stages[0].settings.images)}, and a map is needed: record it for them'
            )
        if filtered and stages[-1].kind == 'plain':
            raise ConfigError(
                'the filter needs a network that says how sure it is, not a plain one'
            )
        localizer = CameraLocalizer(drive.camera, drive.T_base_camera, stages)
    rng = np.random.default_rng([seed, 33])
    start = drive.T_map_base[0] @ _start_error(rng, s)
    speeds = drive.speeds_mps * (1.0 + s.speed_scale * rng.normal())
    speeds = speeds + s.speed_noise * rng.normal(size=len(drive))
    ekf: ThesisTracking | VehicleTracking = ThesisTracking(drive, start)
    if by == VEHICLE:
        ekf = VehicleTracking(drive, start, float(speeds[1]), told or VehicleTrackingConfig())
    found, nees, xi, covariances, skipped = [], [], [], [], 0
    for k in range(1, len(drive)):
        ekf.move(k, float(speeds[k]))
        if localizer is not None and local_map is not None:
            first = localizer.first_stage(ekf.covariance) if filtered else 0
            seen = _observation(localizer, local_map, drive.frames[k], ekf.T_map_base, first, s)
            if seen is None or (filtered and not se3.is_covariance(seen[1])):
                skipped += 1
            else:
                T_seen, covariance = seen
                xi.append(se3.log(se3.inverse(T_seen) @ drive.T_map_base[k]))
                covariances.append(covariance)
                if filtered:
                    ekf.correct(k, T_seen, covariance)
                else:
                    ekf = ThesisTracking(drive, T_seen)
        found.append(ekf.T_map_base)
        nees.append(ekf.nees(drive.T_map_base[k]))
        progress()
    T = np.array(found)
    metres, radians = pose_errors(drive.T_map_base[1:], T)
    return Track(
        seed, T, metres, radians, np.array(nees), np.array(xi).reshape(-1, 6),
        np.array(covariances).reshape(-1, 6, 6), skipped,
    )  # fmt: skip


def _observation(
    localizer: CameraLocalizer,
    local_map: LocalMap,
    framed: np.ndarray,
    T_map_guess: se3.Array,
    first: int,
    s: TrackingConfig,
) -> tuple[se3.Array, se3.Array] | None:
    """Return what the camera says from a prediction: T_map_base and its covariance."""
    points, origin = local_map.around(T_map_guess)
    if not len(points):
        return None
    T_near_guess = near_origin(T_map_guess, origin)
    estimate = localizer.locate_framed(np.array(framed), points, T_near_guess, first)
    if estimate.fill < s.least_fill:
        return None
    return near_origin(estimate.T_map_base, -origin), estimate.covariance


def _start_error(rng: np.random.Generator, s: TrackingConfig) -> se3.Array:
    t, r = s.start_translation, s.start_rotation
    limits = np.array([t, t, min(t, 1.0), r, r, r])  # a camera stands a metre above the road
    return euler.transforms(rng.uniform(-limits, limits))
