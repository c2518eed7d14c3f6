"""Read KITTI-360 in its published layout, or a few frames in a flat one.

    ROOT/calibration/{calib_cam_to_velo,calib_cam_to_pose,perspective}.txt
    ROOT/data_3d_raw/SEQUENCE/velodyne_points/{data/NNNNNNNNNN.bin, timestamps.txt}
    ROOT/data_2d_raw/SEQUENCE/image_00/{data_rect/NNNNNNNNNN.png, timestamps.txt}
    ROOT/data_poses/SEQUENCE/{poses.txt, cam0_to_world.txt}
    ROOT/{calibration, velodyne, image_00} and, where present, poses.txt and timestamps.txt   (flat)

calib_cam_to_velo.txt takes points from the camera to the velodyne. poses.txt gives the GPS/IMU's
pose (its axes: forward, right, down), cam0_to_world.txt that of the rectified camera, for some of
the frames. Sweeps are not motion compensated and carry no point time. Where timestamps.txt is
missing, frames get stamps at the recording's nominal 10 Hz from their numbers, with a warning.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.calibration_file import CalibrationFile, rigid
from bags.folder_drive import FolderDrive
from bags.kitti_car import EPOCH_NS, base_from_lidar, camera_of_projection, mounted
from bags.numbered_files import image_size, numbered_files, read_float32_cloud, read_image
from bags.records import CameraImage, CameraModel, LidarScan, Mounting, Record
from bags.sensor_stream import SensorStream, make_stream
from bags.skips import Skips
from bags.stamp_files import read_date_stamps, stamps_of_numbers
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory

_PERIOD_NS = 100_000_000


@dataclass(frozen=True)
class _Layout:
    """Where the parts of one sequence lie."""

    name: str
    calibration: Path
    scans: Path
    scan_stamps: Path
    images: Path
    image_stamps: Path
    poses: Path


def is_kitti_360(path: Path) -> bool:
    """Tell whether a folder is the data set's root, a sequence's sweeps or the flat layout."""
    if (path / 'data_3d_raw').is_dir() or path.parent.name == 'data_3d_raw':
        return True
    return (path / 'velodyne').is_dir() and (path / 'calibration').is_dir()


def open_kitti_360(path: Path, sequence: str | None = None) -> FolderDrive:
    """Open a sequence, given the root and its name or a part of it (0003), or the flat layout.

    Raises:
        DataError: no or several sequences fit, there are no sweeps, or a file cannot be read.
    """
    layout, skips = _find(path, sequence), Skips()
    scans = numbered_files(layout.scans, ('.bin',), skips)
    if not scans:
        raise DataError(f'{layout.scans}: no scans NNNNNNNNNN.bin in it')
    notes: list[str] = []
    scan_stamps = _stamps(layout.scan_stamps, list(scans), notes, skips)

    def read_scan(entry: int, stamp_ns: int) -> Record:
        return LidarScan(stamp_ns, read_float32_cloud(scans[entry]))

    streams = [_stream(LidarScan, layout.scans, scan_stamps, read_scan, skips)]
    mountings: tuple[Mounting, ...] = (mounted('lidar', np.eye(4)),)
    camera, truth = None, None
    T_lidar_cam0 = _lidar_from_camera(layout, skips)
    if T_lidar_cam0 is not None:
        T_lidar_rect0 = T_lidar_cam0
        if (layout.calibration / 'perspective.txt').is_file():
            perspective = CalibrationFile(layout.calibration / 'perspective.txt')
            R_rect = perspective.rotation('R_rect_00')
            T_lidar_rect0 = T_lidar_cam0 @ se3.from_rotation_translation(R_rect.T, [0.0] * 3)
            images = numbered_files(layout.images, ('.png',), skips)
            camera = _camera_model(perspective, images)
            if camera is not None:
                mountings += (mounted('camera', T_lidar_rect0),)
                image_stamps = _stamps(layout.image_stamps, list(images), notes, skips)

                def read_picture(entry: int, stamp_ns: int) -> Record:
                    return CameraImage(stamp_ns, read_image(images[entry]))

                streams.append(
                    _stream(CameraImage, layout.images, image_stamps, read_picture, skips)
                )
        truth = _truth(layout, T_lidar_cam0, T_lidar_rect0, scan_stamps, skips)
    return FolderDrive(
        f'kitti_360_{layout.name}',
        path,
        streams,
        skips,
        mountings=mountings,
        camera=camera,
        truth=truth,
        notes=tuple(notes),
    )


def _find(path: Path, sequence: str | None) -> _Layout:
    if path.parent.name == 'data_3d_raw':
        path, sequence = path.parent.parent, path.name
    if not (path / 'data_3d_raw').is_dir():
        stamps = path / 'timestamps.txt'
        return _Layout(
            path.name,
            path / 'calibration',
            path / 'velodyne',
            stamps,
            path / 'image_00',
            stamps,
            path,
        )
    names = sorted(p.name for p in (path / 'data_3d_raw').iterdir() if p.is_dir())
    fitting = [name for name in names if sequence is None or sequence in name]
    if len(fitting) != 1:
        asked = 'choose a sequence' if sequence is None else f'{len(fitting)} fit {sequence!r}'
        raise DataError(f'{path}: {asked}; it has {", ".join(names) or "none"}')
    name = fitting[0]
    velodyne = path / 'data_3d_raw' / name / 'velodyne_points'
    image = path / 'data_2d_raw' / name / 'image_00'
    return _Layout(
        name,
        path / 'calibration',
        velodyne / 'data',
        velodyne / 'timestamps.txt',
        image / 'data_rect',
        image / 'timestamps.txt',
        path / 'data_poses' / name,
    )


def _stamps(path: Path, numbers: list[int], notes: list[str], skips: Skips) -> dict[int, int]:
    if path.is_file():
        return stamps_of_numbers(numbers, read_date_stamps(path), path, skips)
    note = f'{path}: missing; stamps follow from the frame numbers at the nominal 10 Hz'
    if note not in notes:
        notes.append(note)
        skips.note(note)
    return {number: EPOCH_NS + number * _PERIOD_NS for number in numbers}


def _stream(
    kind: type[LidarScan] | type[CameraImage],
    folder: Path,
    stamps: dict[int, int],
    read: Callable[[int, int], Record],
    skips: Skips,
) -> SensorStream:
    return make_stream(kind, str(folder), list(stamps.values()), list(stamps), read, skips)


def _lidar_from_camera(layout: _Layout, skips: Skips) -> se3.Array | None:
    path = layout.calibration / 'calib_cam_to_velo.txt'
    if not path.is_file():
        skips.add(
            'calib_cam_to_velo.txt missing: no camera and no ground truth',
            path,
            f"{path}: missing, so there is neither camera nor ground truth; it is in KITTI-360's "
            'calibration archive',
        )
        return None
    values = _numbers(path.read_text())
    if values is None or values.size != 12:
        raise DataError(f'{path}: expected 12 numbers, a 3x4 transform from camera to velodyne')
    matrix = values.reshape(3, 4)
    return rigid(matrix[:, :3], matrix[:, 3], str(path))


def _camera_model(perspective: CalibrationFile, images: dict[int, Path]) -> CameraModel | None:
    size = image_size(list(images.values()))
    return None if size is None else camera_of_projection(perspective, 'P_rect_00', size)[0]


def _truth(
    layout: _Layout,
    T_lidar_cam0: se3.Array,
    T_lidar_rect0: se3.Array,
    stamps: dict[int, int],
    skips: Skips,
) -> Trajectory | None:
    to_pose = layout.calibration / 'calib_cam_to_pose.txt'
    if (layout.poses / 'poses.txt').is_file() and to_pose.is_file():
        path, T_body_lidar = layout.poses / 'poses.txt', se3.inverse(T_lidar_cam0)
        T_body_lidar = CalibrationFile(to_pose).transform('image_00') @ T_body_lidar
    elif (layout.poses / 'cam0_to_world.txt').is_file():
        path, T_body_lidar = layout.poses / 'cam0_to_world.txt', se3.inverse(T_lidar_rect0)
    else:
        return None
    T_body_base = T_body_lidar @ se3.inverse(base_from_lidar())
    poses: dict[int, se3.Array] = {}
    for number, line in enumerate(path.read_text(errors='replace').splitlines(), start=1):
        values = _numbers(line)
        if values is None or values.size not in (13, 17):
            if line.strip():
                message = f'{path}:{number}: expected a frame number and a 3x4 or 4x4 matrix'
                skips.add(f'broken row of {path.name}', (path, number), message)
            continue
        frame = int(values[0])
        if frame in stamps:
            T_world_body = np.eye(4)
            T_world_body[:3] = values[1:13].reshape(3, 4)
            poses[stamps[frame]] = T_world_body @ T_body_base
    ordered = sorted(poses)
    if not ordered:
        return None
    return Trajectory(np.array(ordered, np.int64), np.stack([poses[s] for s in ordered]))


def _numbers(text: str) -> NDArray[np.float64] | None:
    try:
        values = np.array(text.split(), np.float64)
    except ValueError:
        return None
    return values if np.isfinite(values).all() else None
