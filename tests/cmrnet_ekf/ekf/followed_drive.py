"""A drive that a filter follows, with a perfect IMU and a camera."""

import numpy as np
from moving_states import drive

from cmrnet_ekf.ekf.ekf_settings import EkfSettings, MotionConfig, StartConfig
from cmrnet_ekf.ekf.observations import PoseObservation
from cmrnet_ekf.ekf.vehicle_ekf import VehicleEkf
from lcd_common import se3

MOTION = MotionConfig(
    accelerometer_noise=0.05, gyroscope_noise=0.005, accelerometer_walk=0.01, gyroscope_walk=1e-3
)
START = StartConfig(velocity=0.1, gyroscope_bias=0.01, accelerometer_bias=0.05)
START_POSE = np.diag([0.05**2] * 3 + [0.01**2] * 3)
CAMERA = np.diag(np.array([0.1, 0.05, 0.05, 0.004, 0.004, 0.006]) ** 2)
TRUTH = drive(12.0)


def started(settings: EkfSettings | None = None) -> VehicleEkf:
    ekf = VehicleEkf(settings or EkfSettings(motion=MOTION, start=START))
    ekf.start(0, TRUTH.T_map_body[0], START_POSE, TRUTH.velocities[0])
    return ekf


def feed(ekf: VehicleEkf, first: int, last: int) -> None:
    for k in range(first, last):
        ekf.add_imu(int(TRUTH.stamps_ns[k]), TRUTH.turn_rates[k], TRUTH.forces[k])


def follow(ekf: VehicleEkf, last: int) -> None:
    for k in range(10, last + 1, 10):
        feed(ekf, k - 10, k)
        ekf.observe(camera(k))


def camera(k: int, off: se3.Array | None = None) -> PoseObservation:
    T = TRUTH.T_map_body[k] @ se3.exp(np.zeros(6) if off is None else off)
    return PoseObservation(int(TRUTH.stamps_ns[k]), 'camera', T, CAMERA)


def off_truth(ekf: VehicleEkf, k: int) -> float:
    estimate = ekf.estimate(int(TRUTH.stamps_ns[k]))
    assert estimate is not None
    return se3.distance(estimate.T_map_body, TRUTH.T_map_body[k])[0]
