"""Sum up inertial measurements between keyframes.

Forster et al., On-Manifold Preintegration for Real-Time Visual-Inertial Odometry, T-RO 2017.
"""

from collections import deque
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.settings import config, setting


@config
class ImuConfig:
    """Noise of the inertial sensor in continuous time, as its data sheet gives it."""

    accelerometer_noise: float = setting(
        0.02, 'accelerometer noise density', unit='m/s^2/sqrt(Hz)', low=1e-8
    )
    gyroscope_noise: float = setting(
        1e-3, 'gyroscope noise density', unit='rad/s/sqrt(Hz)', low=1e-9
    )
    accelerometer_walk: float = setting(
        1e-3, 'accelerometer bias random walk', unit='m/s^3/sqrt(Hz)', low=1e-10
    )
    gyroscope_walk: float = setting(
        1e-4, 'gyroscope bias random walk', unit='rad/s^2/sqrt(Hz)', low=1e-12
    )
    gravity: float = setting(9.81, 'magnitude of gravity', unit='m/s^2', low=1.0)
    largest_gap: float = setting(
        0.1, 'a longer pause between measurements breaks the sum', unit='s', low=1e-3
    )
    rest_window: float = setting(
        0.5, 'measurements before the first keyframe that level the map', unit='s', low=0.01
    )


@dataclass(frozen=True)
class ImuSample:
    """One measurement in the sensor's axes: rad/s and m/s^2 (specific force, +g at rest)."""

    stamp_ns: int
    angular_velocity: NDArray[np.float64]
    linear_acceleration: NDArray[np.float64]


class ImuPreintegration:
    """Collect samples and sum them up from keyframe to keyframe.

    Args:
        settings: noise and limits.
        T_base_imu: where the sensor sits.
    """

    def __init__(self, settings: ImuConfig, T_base_imu: se3.Array) -> None:
        self.settings = settings
        params = gtsam.PreintegrationCombinedParams.MakeSharedU(settings.gravity)
        params.setAccelerometerCovariance(np.eye(3) * settings.accelerometer_noise**2)
        params.setGyroscopeCovariance(np.eye(3) * settings.gyroscope_noise**2)
        params.setBiasAccCovariance(np.eye(3) * settings.accelerometer_walk**2)
        params.setBiasOmegaCovariance(np.eye(3) * settings.gyroscope_walk**2)
        params.setIntegrationCovariance(np.eye(3) * 1e-8)
        params.setBodyPSensor(gtsam.Pose3(T_base_imu))
        self._params = params
        self._R_base_imu = T_base_imu[:3, :3]
        self._samples: deque[ImuSample] = deque(maxlen=100_000)

    def add(self, sample: ImuSample) -> bool:
        """Take a sample; False when it is not finite or not newer than the last."""
        values = np.concatenate([sample.angular_velocity, sample.linear_acceleration])
        if not np.isfinite(values).all():
            return False
        if self._samples and sample.stamp_ns <= self._samples[-1].stamp_ns:
            return False
        self._samples.append(sample)
        return True

    def level(self, stamp_ns: int) -> se3.Array | None:
        """Return T_map_base of the first keyframe with z up, from gravity; None without samples.

        Right at rest or at constant speed; the graph's prior leaves room for the rest.
        """
        window = int(self.settings.rest_window * 1e9)
        force = [
            s.linear_acceleration for s in self._samples if 0 <= stamp_ns - s.stamp_ns <= window
        ]
        if len(force) < 3:
            return None
        up = self._R_base_imu @ np.mean(force, axis=0)
        if not 0.8 < np.linalg.norm(up) / self.settings.gravity < 1.2:
            return None
        roll = np.arctan2(up[1], up[2])
        pitch = np.arctan2(-up[0], np.hypot(up[1], up[2]))
        R = se3.so3_exp([0, pitch, 0]) @ se3.so3_exp([roll, 0, 0])
        return se3.from_rotation_translation(R, np.zeros(3))

    def between(
        self, start_ns: int, end_ns: int, bias: gtsam.imuBias.ConstantBias
    ) -> gtsam.PreintegratedCombinedMeasurements | None:
        """Sum up from one stamp to another and forget what came before; None where samples lack."""
        while len(self._samples) > 1 and self._samples[1].stamp_ns <= start_ns:
            self._samples.popleft()
        total = gtsam.PreintegratedCombinedMeasurements(self._params, bias)
        gap_ns = int(self.settings.largest_gap * 1e9)
        at_ns = start_ns
        for k, sample in enumerate(self._samples):
            if sample.stamp_ns >= end_ns:
                break
            later = self._samples[k + 1].stamp_ns if k + 1 < len(self._samples) else end_ns
            until_ns = min(later, end_ns)
            if sample.stamp_ns > at_ns + gap_ns or until_ns - max(sample.stamp_ns, at_ns) > gap_ns:
                return None
            # A sample holds until the next one; the first also covers what little lies before it.
            if until_ns > at_ns:
                total.integrateMeasurement(
                    sample.linear_acceleration, sample.angular_velocity, (until_ns - at_ns) * 1e-9
                )
                at_ns = until_ns
        return total if at_ns == end_ns and end_ns > start_ns else None
