"""Hold what sensors recorded, whatever the file format was.

Frames of a drive, all right-handed, metres (REP-103/105): `base_link` on the ground below the LiDAR
(x forward, z up) unless the recording has its own; `lidar`; `camera` (an optical frame: z forward,
x right); `imu`; `gps`.
"""

from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.trajectory import Trajectory


@dataclass(frozen=True)
class LidarScan:
    """One sweep in the sensor's own frame."""

    stamp_ns: int
    cloud: PointCloud
    frame_id: str = 'lidar'


@dataclass(frozen=True)
class CameraImage:
    """One image: [H x W] grey or [H x W x 3] RGB, uint8."""

    stamp_ns: int
    pixels: NDArray[np.uint8]
    frame_id: str = 'camera'


@dataclass(frozen=True)
class CameraModel:
    """Pinhole calibration: K [3 x 3] pixels, distortion by OpenCV's plumb_bob (k1 k2 p1 p2 k3)."""

    frame_id: str
    width: int
    height: int
    K: NDArray[np.float64]
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ImuSample:
    """One IMU reading in the sensor's frame: rad/s and m/s^2, gravity included."""

    stamp_ns: int
    angular_velocity: NDArray[np.float64]
    linear_acceleration: NDArray[np.float64]
    frame_id: str = 'imu'


@dataclass(frozen=True)
class GnssFix:
    """One satellite fix: WGS-84 degrees, metres; covariance 3x3 east-north-up, None if unknown."""

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance_enu: NDArray[np.float64] | None = None
    frame_id: str = 'gps'


@dataclass(frozen=True)
class TwistSample:
    """One velocity of a body in its own frame: m/s and rad/s; covariance 6x6, None if unknown."""

    stamp_ns: int
    linear: NDArray[np.float64]
    angular: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None
    frame_id: str = 'base_link'


@dataclass(frozen=True)
class TruthPose:
    """Reference pose of base_link in the data set's own world frame."""

    stamp_ns: int
    T_world_base: se3.Array


Record = LidarScan | CameraImage | ImuSample | GnssFix | TwistSample | TruthPose


@dataclass(frozen=True)
class Mounting:
    """Where a sensor sits: T_parent_child from the calibration."""

    parent: str
    child: str
    T_parent_child: se3.Array


@dataclass(frozen=True)
class Stream:
    """What a drive holds of one kind: topic, message type, count and span."""

    topic: str
    type_name: str
    count: int
    first_ns: int | None
    last_ns: int | None


class Drive(Protocol):
    """The common interface of every reader: lazily read, in stamp order."""

    name: str
    path: Path
    mountings: tuple[Mounting, ...]
    camera: CameraModel | None
    skipped: 'Counter[str]'  # what could not be read, by cause

    def streams(self) -> list[Stream]:
        """List what the drive holds, without reading the sensors' data."""
        ...

    def records(
        self,
        start_ns: int | None = None,
        end_ns: int | None = None,
        kinds: Collection[type[Record]] | None = None,
    ) -> Iterator[Record]:
        """Yield everything between two stamps (inclusive) in stamp order, one sweep at a time.

        With `kinds` only these are read: a sensor that nobody listens to costs nothing.
        """
        ...

    def truth(self) -> Trajectory | None:
        """Return the reference trajectory of base_link, or None when there is none."""
        ...
