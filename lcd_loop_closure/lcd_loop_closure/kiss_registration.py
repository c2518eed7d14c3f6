"""Run KISS-ICP's parts one by one, so that a badly registered sweep need not enter its map."""

import logging

import numpy as np
from kiss_icp.config import KISSConfig
from kiss_icp.config.config import (
    AdaptiveThresholdConfig,
    DataConfig,
    MappingConfig,
    RegistrationConfig,
)
from kiss_icp.mapping import get_voxel_hash_map
from kiss_icp.preprocess import get_preprocessor
from kiss_icp.registration import get_registration
from kiss_icp.threshold import get_threshold_estimator
from kiss_icp.voxelization import voxel_down_sample

from lcd_common import se3
from lcd_common.se3 import Array

_log = logging.getLogger(__name__)

_ROUGH_ITERATIONS = 30
_BRIEF_ITERATIONS = 12
# Norm of the last step, metres and radians; KISS-ICP's own is 1e-4.
_BRIEF_CONVERGENCE = 1e-2

_asked_threads: list[int] = []  # each number once, in the order in which this process asked


class KissRegistration:
    """KISS-ICP (Vizzo et al., RA-L 2023), as its `KissICP.register_frame` puts it together.

    That method adds every sweep to the map at once and always guesses the same motion again.
    """

    def __init__(
        self, max_range: float, min_range: float, voxel_size: float, max_num_threads: int
    ) -> None:
        """Start with an empty map; lengths in metres, 0 threads are all.

        The number of threads belongs to the process: KISS-ICP keeps that of its first user. Another
        number is said once in the log.
        """
        _note_threads(max_num_threads)
        # Everything is named, as KISSConfig otherwise reads the environment.
        self._config = KISSConfig(
            data=DataConfig(max_range=max_range, min_range=min_range, deskew=True),
            mapping=MappingConfig(voxel_size=voxel_size),
            registration=RegistrationConfig(max_num_threads=max_num_threads),
            adaptive_threshold=AdaptiveThresholdConfig(),
        )
        self._preprocessor = get_preprocessor(self._config)
        self._registration = get_registration(self._config)
        rough = self._config.model_copy(deep=True)
        rough.registration.max_num_iterations = _ROUGH_ITERATIONS
        self._rough_registration = get_registration(rough)
        brief = self._config.model_copy(deep=True)
        brief.registration.convergence_criterion = _BRIEF_CONVERGENCE
        brief.registration.max_num_iterations = _BRIEF_ITERATIONS
        self._brief_registration = get_registration(brief)
        self.clear()

    def clear(self) -> None:
        """Forget the map and how well motions were guessed."""
        self._map = get_voxel_hash_map(self._config)
        self._threshold = get_threshold_estimator(self._config)

    def preprocess(self, xyz: Array, time_s: Array | None, T_begin_end: Array) -> Array:
        """Return the points in range [M x 3], moved to the instant of the last one.

        Args:
            xyz: [N x 3] metres.
            time_s: [N] seconds, or None to leave the points where they are.
            T_begin_end: motion of the sensor from the first point's time to the last one's.
        """
        times = np.empty(0) if time_s is None else time_s
        return np.asarray(self._preprocessor.preprocess(xyz, times, T_begin_end))

    def downsample(self, xyz: Array) -> tuple[Array, Array]:
        """Return the points for the map and the fewer ones to register."""
        voxel_size = self._config.mapping.voxel_size
        dense = voxel_down_sample(xyz, 0.5 * voxel_size)
        return dense, voxel_down_sample(dense, 1.5 * voxel_size)

    def align(
        self, source: Array, T_map_guess: Array, *, rough: bool = False, brief: bool = False
    ) -> Array:
        """Return the pose T_map_lidar.

        Briefly is to end centimetres before KISS-ICP would, for somebody who goes on from there.

        Roughly is from a guess that may be far off or wrong: with twice the distance that matches
        may have, and few iterations, as what does not fit would go on for seconds.
        """
        sigma = (2.0 if rough else 1.0) * self._threshold.get_threshold()
        registration = self._brief_registration if brief else self._registration
        registration = self._rough_registration if rough else registration
        T_map_lidar: Array = registration.align_points_to_map(
            points=source,
            voxel_map=self._map,
            initial_guess=T_map_guess,
            max_correspondance_distance=3.0 * sigma,
            kernel=sigma,
        )
        return T_map_lidar

    def note_deviation(self, T_map_guess: Array, T_map_lidar: Array) -> None:
        """Learn from how far a guess was off."""
        self._threshold.update_model_deviation(se3.inverse(T_map_guess) @ T_map_lidar)

    def add(self, dense: Array, T_map_lidar: Array) -> None:
        """Add a registered sweep to the map."""
        self._map.update(dense, T_map_lidar)

    def points(self) -> Array:
        """Return the points of the map [N x 3]."""
        return np.asarray(self._map.point_cloud())


def _note_threads(asked: int) -> None:
    if asked in _asked_threads:
        return
    _asked_threads.append(asked)
    if asked != _asked_threads[0]:
        _log.warning(
            'threads = %d has no effect: KISS-ICP keeps the %d (0: all) of the first odometry in '
            'the process; give all odometries the same number, or this one a process of its own',
            asked,
            _asked_threads[0],
        )
