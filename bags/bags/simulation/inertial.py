"""Measure what an inertial unit on a moving car feels."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lcd_common import se3
from lcd_common.errors import ConfigError

GRAVITY = 9.81
_DEGREE = np.pi / 180.0
_STEP_S = 0.005  # of the central differences: the motion has no detail of that length


@dataclass(frozen=True)
class ImuModel:
    """Allan parameters of an inertial unit, each for one axis.

    Attributes:
        name: what users call it.
        gyro_noise: rad/s/sqrt(Hz), the angular random walk.
        gyro_walk: rad/s^2/sqrt(Hz), of the bias.
        gyro_bias: rad/s, standard deviation of the bias when it starts.
        accelerometer_noise: m/s^2/sqrt(Hz), the velocity random walk.
        accelerometer_walk: m/s^3/sqrt(Hz), of the bias.
        accelerometer_bias: m/s^2, standard deviation of the bias when it starts.
    """

    name: str
    gyro_noise: float
    gyro_walk: float
    gyro_bias: float
    accelerometer_noise: float
    accelerometer_walk: float
    accelerometer_bias: float


IMUS: dict[str, ImuModel] = {
    model.name: model
    for model in (
        # OXTS RT3000 family (KITTI's RT3003) as its data sheet is commonly quoted: 0.2 deg/sqrt(h)
        # and 0.005 m/s/sqrt(h), bias stability 2 deg/h and 2 micro-g. The walks are set so that a
        # bias moves by its stability within ten minutes; the start is one stability too, since the
        # unit's own filter takes out the rest.
        ImuModel(
            'rt3003',
            gyro_noise=0.2 * _DEGREE / 60.0,
            gyro_walk=2.0 * _DEGREE / 3600.0 / np.sqrt(600.0),
            gyro_bias=2.0 * _DEGREE / 3600.0,
            accelerometer_noise=0.005 / 60.0,
            accelerometer_walk=2e-6 * GRAVITY / np.sqrt(600.0),
            accelerometer_bias=2e-6 * GRAVITY,
        ),
        # ADIS16448 as in the EuRoC data set's imu0/sensor.yaml (noise and walks). The biases at
        # the start are a judgement: what is left after standing still for some seconds.
        ImuModel(
            'mems',
            gyro_noise=1.6968e-4,
            gyro_walk=1.9393e-5,
            gyro_bias=4e-3,
            accelerometer_noise=2.0e-3,
            accelerometer_walk=3.0e-3,
            accelerometer_bias=0.05,
        ),
    )
}


@dataclass(frozen=True)
class InertialLog:
    """Samples in the sensor's frame: angular_velocity [N x 3] rad/s, force [N x 3] m/s^2."""

    angular_velocity: se3.Array
    linear_acceleration: se3.Array


def imu_model(name: str) -> ImuModel:
    """Return the inertial unit of a name; raises ConfigError when there is none."""
    if name not in IMUS:
        raise ConfigError(f'an imu is one of {", ".join(IMUS)}, got {name!r}')
    return IMUS[name]


def felt(
    T_world_base: Callable[[se3.Array], se3.Array], T_base_imu: se3.Array, time_s: se3.Array
) -> InertialLog:
    """Return what a faultless unit measures at times [N], gravity included.

    Args:
        T_world_base: poses [N x 4 x 4] at times [N]; world axes with z up.
        T_base_imu: where the unit sits.
        time_s: [N].
    """
    before, now, after = (
        T_world_base(time_s + step) @ T_base_imu for step in (-_STEP_S, 0.0, _STEP_S)
    )
    turned = np.swapaxes(before[:, :3, :3], 1, 2) @ after[:, :3, :3]
    force = (before[:, :3, 3] - 2.0 * now[:, :3, 3] + after[:, :3, 3]) / _STEP_S**2
    force[:, 2] += GRAVITY
    return InertialLog(
        _small_rotations(turned) / (2.0 * _STEP_S), np.einsum('nji,nj->ni', now[:, :3, :3], force)
    )


def measured(log: InertialLog, model: ImuModel, rate_hz: float, seed: int) -> InertialLog:
    """Return a unit's samples: white noise, and biases that walk."""
    rng = np.random.default_rng([seed, 31])
    out = []
    for true, noise, walk, bias in (
        (log.angular_velocity, model.gyro_noise, model.gyro_walk, model.gyro_bias),
        (
            log.linear_acceleration,
            model.accelerometer_noise,
            model.accelerometer_walk,
            model.accelerometer_bias,
        ),
    ):
        start = rng.normal(0.0, bias, 3)
        walked = np.cumsum(rng.normal(0.0, walk / np.sqrt(rate_hz), true.shape), axis=0)
        out.append(true + start + walked + rng.normal(0.0, noise * np.sqrt(rate_hz), true.shape))
    return InertialLog(out[0], out[1])


def _small_rotations(R: se3.Array) -> se3.Array:
    """Return the rotation vectors [N x 3] of small rotations [N x 3 x 3]."""
    twice = np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1
    )
    sine = np.clip(0.5 * np.linalg.norm(twice, axis=1, keepdims=True), 0.0, 1.0)
    factor = np.where(sine > 1e-7, np.arcsin(sine) / np.maximum(sine, 1e-12), 1.0)
    return np.asarray(0.5 * twice * factor)
