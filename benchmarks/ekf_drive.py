"""Make a drive whose motion is known exactly, and what an inertial sensor says of it."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3

RATE_HZ = 100
_FINER = 10


@dataclass(frozen=True)
class ReferenceDrive:
    """Truth at the stamps of the inertial samples.

    Attributes:
        stamps_ns: [N].
        T_map_body: [N x 4 x 4].
        velocities: [N x 3] in map axes.
        turn_rates, forces: [N x 3]; each holds exactly until the next stamp.
    """

    stamps_ns: NDArray[np.int64]
    T_map_body: se3.Array
    velocities: se3.Array
    turn_rates: se3.Array
    forces: se3.Array


def reference_drive(seconds: float, gravity: float = 9.81, start_ns: int = 0) -> ReferenceDrive:
    """Drive through town: 5 to 11 m/s, bends of both hands, some roll, pitch and hills."""
    dt = 1.0 / (RATE_HZ * _FINER)
    t = np.arange(round(seconds * RATE_HZ) * _FINER + 1) * dt
    speed = 8.0 + 3.0 * np.sin(0.2 * t)
    yaw = 1.2 * np.sin(0.15 * t) + 0.4 * np.sin(0.5 * t)
    climb = 0.05 * np.cos(0.1 * t)
    velocity = np.stack([speed * np.cos(yaw), speed * np.sin(yaw), climb], axis=1)
    way = np.zeros_like(velocity)
    way[1:] = np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * dt, axis=0)
    t, yaw, velocity, way = t[::_FINER], yaw[::_FINER], velocity[::_FINER], way[::_FINER]
    roll, pitch = 0.02 * np.sin(0.7 * t), 0.02 * np.sin(0.45 * t)
    R = np.array(
        [
            se3.so3_exp([0, 0, c]) @ se3.so3_exp([0, b, 0]) @ se3.so3_exp([a, 0, 0])
            for a, b, c in zip(roll, pitch, yaw, strict=True)
        ]
    )
    dt = 1.0 / RATE_HZ
    turn = np.array([se3.so3_log(a.T @ b) for a, b in pairwise(R)]) / dt
    gained = (velocity[1:] - velocity[:-1]) / dt + [0.0, 0.0, gravity]
    forces = np.array(
        [
            np.linalg.solve(np.eye(3) + 0.5 * dt * se3.hat(w), r.T @ a)
            for r, w, a in zip(R[:-1], turn, gained, strict=True)
        ]
    )
    T = np.tile(np.eye(4), (len(R), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R, way
    stamps_ns = start_ns + np.round(t * 1e9).astype(np.int64)
    return ReferenceDrive(stamps_ns[:-1], T[:-1], velocity[:-1], turn, forces)


@dataclass(frozen=True)
class ImuRecord:
    """What a sensor with noise and wandering biases said [N x 3], and its biases."""

    turn_rates: se3.Array
    forces: se3.Array
    gyroscope_bias: se3.Array
    accelerometer_bias: se3.Array


def sense(
    drive: ReferenceDrive,
    rng: np.random.Generator,
    *,
    noise: tuple[float, float],
    walk: tuple[float, float],
    bias: tuple[float, float],
) -> ImuRecord:
    """Return samples of a drive.

    Args:
        drive: the truth.
        rng: of this run.
        noise: densities of gyroscope and accelerometer.
        walk: of their biases, densities.
        bias: sigmas of their biases at the start.
    """
    n, dt = len(drive.stamps_ns), 1.0 / RATE_HZ
    biases = []
    for start, density in zip(bias, walk, strict=True):
        steps = rng.normal(size=(n, 3)) * density * np.sqrt(dt)
        steps[0] = rng.normal(size=3) * start
        biases.append(np.cumsum(steps, axis=0))
    noises = [rng.normal(size=(n, 3)) * density / np.sqrt(dt) for density in noise]
    return ImuRecord(
        drive.turn_rates + biases[0] + noises[0],
        drive.forces + biases[1] + noises[1],
        biases[0],
        biases[1],
    )
