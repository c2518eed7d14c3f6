"""Make the state that the filter starts with."""

import numpy as np

from cmrnet_ekf.ekf.ekf_settings import EkfSettings
from cmrnet_ekf.ekf.motion_state import (
    ACCELEROMETER,
    GYROSCOPE,
    POSE,
    SIZE,
    VELOCITY,
    MotionState,
)
from lcd_common import se3


def start_state(
    settings: EkfSettings,
    stamp_ns: int,
    T_map_body: se3.Array,
    covariance: se3.Array | None,
    velocity_map: se3.Array | None,
    velocity_sigma: float | None,
    kept: MotionState | None,
) -> MotionState:
    """Return the state at a pose; the biases of `kept` stay, for they belong to the sensor.

    Args are those of `VehicleEkf.start`; `kept` is the state before, None at the first start.
    """
    start = settings.start
    P = np.zeros((SIZE, SIZE))
    if covariance is None:
        covariance = np.diag([start.position**2] * 3 + [start.rotation**2] * 3)
    P[POSE, POSE] = covariance
    sigma = start.velocity if velocity_sigma is None else velocity_sigma
    P[VELOCITY, VELOCITY] = sigma**2 * np.eye(3)
    biases = np.zeros(3), np.zeros(3)
    if kept is not None:
        biases = kept.gyroscope_bias, kept.accelerometer_bias
        P[GYROSCOPE, GYROSCOPE] = kept.covariance[GYROSCOPE, GYROSCOPE]
        P[ACCELEROMETER, ACCELEROMETER] = kept.covariance[ACCELEROMETER, ACCELEROMETER]
    elif settings.motion.estimate_biases:
        P[GYROSCOPE, GYROSCOPE] = start.gyroscope_bias**2 * np.eye(3)
        P[ACCELEROMETER, ACCELEROMETER] = start.accelerometer_bias**2 * np.eye(3)
    return MotionState(
        stamp_ns,
        T_map_body[:3, :3].copy(),
        T_map_body[:3, 3].copy(),
        np.zeros(3) if velocity_map is None else np.asarray(velocity_map, np.float64),
        biases[0],
        biases[1],
        P,
    )
