"""Read sequences of MulRan (Ouster OS1-64 on a car).

    SEQUENCE/{Ouster/STAMP.bin, global_pose.csv, gps.csv, xsens_imu.csv}

The sensors' files may also lie in SEQUENCE/sensor_data. Stamps are nanoseconds. A sweep is float32
x y z intensity; points at the origin are missing returns and are left out. The files carry no point
time. (The order of complete sweeps would tell the column of each point, but neither which column
the stamp means nor whether a sweep is complete, so no time is made from it.)

global_pose.csv is the pose of the vehicle's base in UTM, gps.csv latitude, longitude, altitude and
a covariance, xsens_imu.csv attitude, Euler angles, rates, accelerations and magnetic field. The
data set does not say where IMU and GNSS antenna sit: they have no mounting.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.folder_drive import FolderDrive
from bags.numbered_files import numbered_files, read_float32_cloud
from bags.records import GnssFix, ImuSample, LidarScan, Mounting, Record
from bags.sensor_stream import SensorStream, make_stream
from bags.skips import Skips
from bags.stamp_files import read_stamped_rows
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory

# The data set's published extrinsics of the Ouster: metres, and roll pitch yaw in degrees.
_OUSTER_XYZ = (1.7042, -0.021, 1.8047)
_OUSTER_RPY_DEG = (0.0001, 0.0003, 179.6654)


def is_mulran(path: Path) -> bool:
    """Tell whether a folder is a sequence."""
    return (path / 'Ouster').is_dir() or (path / 'sensor_data' / 'Ouster').is_dir()


def open_mulran(path: Path) -> FolderDrive:
    """Open a sequence, given its folder.

    Raises:
        DataError: it has no sweeps.
    """
    skips = Skips()
    sensors = path if (path / 'Ouster').is_dir() else path / 'sensor_data'
    files = numbered_files(sensors / 'Ouster', ('.bin',), skips)
    if not files:
        raise DataError(f'{sensors / "Ouster"}: no scans STAMP.bin in it; unpack the Ouster data')

    def read_scan(entry: int, stamp_ns: int) -> Record:
        cloud = read_float32_cloud(files[entry])
        return LidarScan(stamp_ns, cloud.select((cloud.xyz != 0).any(axis=1)))

    stamps = list(files)
    source = str(sensors / 'Ouster')
    streams = [make_stream(LidarScan, source, stamps, stamps, read_scan, skips)]
    streams += _imu(_first_of(sensors, path, 'xsens_imu.csv'), skips)
    streams += _fixes(_first_of(sensors, path, 'gps.csv'), skips)
    return FolderDrive(
        f'mulran_{path.name}',
        path,
        streams,
        skips,
        mountings=(Mounting('base_link', 'lidar', base_from_ouster()),),
        truth=_truth(_first_of(path, sensors, 'global_pose.csv'), skips),
    )


def base_from_ouster() -> se3.Array:
    """Return T_base_lidar of MulRan's car; the Ouster looks backwards."""
    roll, pitch, yaw = np.radians(_OUSTER_RPY_DEG)
    R = se3.so3_exp([0, 0, yaw]) @ se3.so3_exp([0, pitch, 0]) @ se3.so3_exp([roll, 0, 0])
    return se3.from_rotation_translation(R, _OUSTER_XYZ)


def _first_of(folder: Path, other: Path, name: str) -> Path | None:
    return next((f / name for f in (folder, other) if (f / name).is_file()), None)


def _imu(path: Path | None, skips: Skips) -> list[SensorStream]:
    if path is None:
        return []
    stamps, rows = read_stamped_rows(path, 17, skips)
    rates, accelerations = rows[:, 7:10], rows[:, 10:13]

    def read(entry: int, stamp_ns: int) -> Record:
        return ImuSample(stamp_ns, rates[entry].copy(), accelerations[entry].copy())

    return [make_stream(ImuSample, str(path), stamps, np.arange(len(stamps)), read, skips)]


def _fixes(path: Path | None, skips: Skips) -> list[SensorStream]:
    if path is None:
        return []
    stamps, rows = read_stamped_rows(path, 13, skips)

    def read(entry: int, stamp_ns: int) -> Record:
        latitude, longitude, altitude = rows[entry, :3].tolist()
        covariance: NDArray[np.float64] | None = rows[entry, 3:].reshape(3, 3).copy()
        if covariance is not None and not covariance.any():
            covariance = None
        return GnssFix(stamp_ns, latitude, longitude, altitude, covariance)

    return [make_stream(GnssFix, str(path), stamps, np.arange(len(stamps)), read, skips)]


def _truth(path: Path | None, skips: Skips) -> Trajectory | None:
    if path is None:
        return None
    stamps, rows = read_stamped_rows(path, 13, skips)
    if not len(stamps):
        return None
    ordered, first = np.unique(stamps, return_index=True)
    poses = np.tile(np.eye(4), (len(ordered), 1, 1))
    poses[:, :3] = rows[first].reshape(-1, 3, 4)
    return Trajectory(ordered, poses)
