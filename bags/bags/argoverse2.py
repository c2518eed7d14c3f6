"""Read logs of Argoverse 2 (Sensor and Lidar data sets).

    LOG/sensors/lidar/STAMP.feather                        x y z intensity laser_number offset_ns
    LOG/sensors/cameras/ring_front_center/STAMP.jpg
    LOG/calibration/{egovehicle_SE3_sensor,intrinsics}.feather
    LOG/city_SE3_egovehicle.feather

base_link is the data set's egovehicle frame (rear axle, x forward, z up). A sweep holds the returns
of both lidars in that frame, already compensated for the car's motion to the sweep's stamp, and is
given here in the frame of the upper one. offset_ns says when each return was measured; since the
motion is taken out, handing it on as point time would make an odometry take it out a second time.
The images are published without distortion: k1 to k3 describe the lens before that.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.feather_file import read_columns, read_names
from bags.folder_drive import FolderDrive
from bags.numbered_files import image_size, numbered_files, read_image
from bags.records import CameraImage, CameraModel, LidarScan, Mounting, Record
from bags.sensor_stream import SensorStream, make_stream
from bags.skips import Skips, UnreadableError
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory

_CAMERA = 'ring_front_center'
_LIDAR = 'up_lidar'
_POSE_COLUMNS = ('qx', 'qy', 'qz', 'qw', 'tx_m', 'ty_m', 'tz_m')


def is_argoverse2(path: Path) -> bool:
    """Tell whether a folder is a log."""
    return (path / 'sensors' / 'lidar').is_dir()


def open_argoverse2(path: Path) -> FolderDrive:
    """Open a log, given its folder.

    Raises:
        DataError: it has no sweeps, or a calibration or pose file cannot be read.
    """
    skips = Skips()
    folder = path / 'sensors' / 'lidar'
    files = numbered_files(folder, ('.feather',), skips)
    if not files:
        raise DataError(f'{folder}: no sweeps STAMP.feather in it')
    sensors = _sensors(path / 'calibration' / 'egovehicle_SE3_sensor.feather', skips)
    T_base_lidar = sensors.get(_LIDAR)
    frame = 'base_link' if T_base_lidar is None else 'lidar'

    def read_scan(entry: int, stamp_ns: int) -> Record:
        cloud = _read_sweep(files[entry])
        if T_base_lidar is not None:
            cloud = cloud.transformed(se3.inverse(T_base_lidar))
        return LidarScan(stamp_ns, cloud, frame)

    streams = [make_stream(LidarScan, str(folder), list(files), list(files), read_scan, skips)]
    mountings: tuple[Mounting, ...] = ()
    if T_base_lidar is not None:
        mountings = (Mounting('base_link', 'lidar', T_base_lidar),)
    camera = None
    if _CAMERA in sensors:
        camera, images = _camera(path, skips)
        streams += images
        if camera is not None:
            mountings += (Mounting('base_link', 'camera', sensors[_CAMERA]),)
    return FolderDrive(
        f'argoverse2_{path.name}',
        path,
        streams,
        skips,
        mountings=mountings,
        camera=camera,
        truth=_truth(path / 'city_SE3_egovehicle.feather'),
        notes=('sweeps are motion compensated; offset_ns is left out on purpose',),
    )


def _read_sweep(path: Path) -> PointCloud:
    try:
        table = read_columns(path, ('x', 'y', 'z', 'intensity'))
    except DataError as error:
        raise UnreadableError('unreadable scan file', str(error)) from None
    xyz = np.stack([table[axis].astype(np.float32) for axis in 'xyz'], axis=1)
    return PointCloud(xyz, table['intensity'].astype(np.float32))


def _sensors(path: Path, skips: Skips) -> dict[str, se3.Array]:
    if not path.is_file():
        skips.add(
            'calibration missing: sweeps stay in base_link, no camera',
            path,
            f'{path}: missing; sweeps stay in the egovehicle frame and there is no camera',
        )
        return {}
    poses = _poses(read_columns(path, _POSE_COLUMNS), path)
    return dict(zip(read_names(path, 'sensor_name'), poses, strict=True))


def _poses(table: dict[str, NDArray[np.generic]], path: Path) -> se3.Array:
    rows = np.stack([table[name].astype(np.float64) for name in _POSE_COLUMNS], axis=1)
    try:
        poses = [se3.from_xyz_quaternion(row[4:], row[:4]) for row in rows]
    except ValueError as error:
        raise DataError(f'{path}: {error}') from None
    return np.array(poses).reshape(-1, 4, 4)


def _camera(path: Path, skips: Skips) -> tuple[CameraModel | None, list[SensorStream]]:
    folder = path / 'sensors' / 'cameras' / _CAMERA
    files = numbered_files(folder, ('.jpg', '.png'), skips)
    size = image_size(list(files.values()))
    intrinsics = path / 'calibration' / 'intrinsics.feather'
    if size is None or not intrinsics.is_file():
        return None, []
    table = read_columns(intrinsics, ('fx_px', 'fy_px', 'cx_px', 'cy_px'))
    names = read_names(intrinsics, 'sensor_name')
    if _CAMERA not in names:
        raise DataError(f'{intrinsics}: {_CAMERA} is missing; it has {", ".join(names)}')
    row = names.index(_CAMERA)
    K = np.eye(3)
    K[0, 0], K[1, 1] = float(table['fx_px'][row]), float(table['fy_px'][row])
    K[0, 2], K[1, 2] = float(table['cx_px'][row]), float(table['cy_px'][row])

    def read(entry: int, stamp_ns: int) -> Record:
        return CameraImage(stamp_ns, read_image(files[entry]))

    stream = make_stream(CameraImage, str(folder), list(files), list(files), read, skips)
    return CameraModel('camera', size[0], size[1], K), [stream]


def _truth(path: Path) -> Trajectory | None:
    if not path.is_file():
        return None
    table = read_columns(path, ('timestamp_ns', *_POSE_COLUMNS))
    stamps, first = np.unique(table['timestamp_ns'].astype(np.int64), return_index=True)
    return Trajectory(stamps, _poses(table, path)[first]) if len(stamps) else None
