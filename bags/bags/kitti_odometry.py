"""Read sequences of the KITTI odometry benchmark, also in SemanticKITTI's layout.

    ROOT/sequences/00/{velodyne/NNNNNN.bin, labels/NNNNNN.label, image_2/NNNNNN.png, calib.txt,
                       times.txt, poses.txt}
    ROOT/poses/00.txt

File NNNNNN belongs to row NNNNNN of times and poses, so a sequence may have gaps. The sweeps are
motion compensated and carry no point time. poses/00.txt is preferred to SemanticKITTI's poses.txt;
both give the left camera's pose P, and the velodyne's is inv(Tr) P Tr.
"""

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.calibration_file import CalibrationFile
from bags.folder_drive import FolderDrive
from bags.kitti_car import EPOCH_NS, base_from_lidar, camera_of_projection, mounted
from bags.numbered_files import (
    image_size,
    numbered_files,
    read_float32_cloud,
    read_image,
    read_labels,
)
from bags.records import CameraImage, CameraModel, LidarScan, Mounting, Record
from bags.sensor_stream import SensorStream, make_stream
from bags.skips import Skips, UnreadableError
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory, read_poses

_log = logging.getLogger(__name__)
_CAMERAS = (('image_2', 'P2'), ('image_0', 'P0'))  # colour before grey


def is_kitti_odometry(path: Path) -> bool:
    """Tell whether a folder is a sequence, or holds `sequences/`."""
    if (path / 'calibration').is_dir():
        return False  # KITTI-360's flat layout
    return (path / 'velodyne').is_dir() or (path / 'sequences').is_dir()


def find_sequence(path: Path, sequence: str | None) -> Path:
    """Return the folder of a sequence.

    Raises:
        DataError: it is not there, or there are several and none was chosen.
    """
    if not (path / 'sequences').is_dir():
        if sequence is not None and path.name != sequence:
            raise DataError(
                f'{path}: no sequences/{sequence} in it; give the folder above sequences'
            )
        return path
    names = sorted(p.name for p in (path / 'sequences').iterdir() if (p / 'velodyne').is_dir())
    if sequence is None and len(names) == 1:
        return path / 'sequences' / names[0]
    if sequence in names:
        return path / 'sequences' / str(sequence)
    listed = ', '.join(names) or 'none'
    if sequence is None:
        raise DataError(f'{path}: choose a sequence; those with a velodyne folder are: {listed}')
    raise DataError(f'{path}: no sequence {sequence}; those with a velodyne folder are: {listed}')


def open_kitti_odometry(path: Path, sequence: str | None = None) -> FolderDrive:
    """Open a sequence, given its folder or the data set's root and the sequence's name.

    Raises:
        DataError: times.txt or all scans are missing, or a text file cannot be read.
    """
    folder, skips = find_sequence(path, sequence), Skips()
    times_ns = _read_times(folder / 'times.txt')
    scans = numbered_files(folder / 'velodyne', ('.bin',), skips)
    if not scans:
        raise DataError(
            f'{folder / "velodyne"}: no scans NNNNNN.bin in it; unpack the velodyne data'
        )
    streams = [_files_stream(LidarScan, folder / 'velodyne', scans, times_ns, skips)]
    mountings: tuple[Mounting, ...] = (mounted('lidar', np.eye(4)),)
    camera, truth = None, None
    if (folder / 'calib.txt').is_file():
        calibration = CalibrationFile(folder / 'calib.txt')
        T_cam0_lidar = calibration.transform('Tr')
        truth = _read_truth(folder, times_ns, T_cam0_lidar, skips)
        for name, entry in _CAMERAS:
            images = numbered_files(folder / name, ('.png', '.jpg'), skips)
            size = image_size(list(images.values()))
            if size is None:
                continue
            camera, T_cam_cam0 = camera_of_projection(calibration, entry, size)
            mountings += (mounted('camera', se3.inverse(T_cam_cam0 @ T_cam0_lidar)),)
            streams.append(_files_stream(CameraImage, folder / name, images, times_ns, skips))
            break
    else:
        skips.add(
            'calib.txt missing: no camera and no ground truth',
            folder,
            f'{folder / "calib.txt"}: missing, so there is neither camera nor ground truth; '
            "it is in KITTI's odometry calibration archive",
        )
    return _drive(folder, streams, skips, mountings, camera, truth)


def _drive(
    folder: Path,
    streams: list[SensorStream],
    skips: Skips,
    mountings: tuple[Mounting, ...],
    camera: CameraModel | None,
    truth: Trajectory | None,
) -> FolderDrive:
    return FolderDrive(
        f'kitti_odometry_{folder.name}',
        folder,
        streams,
        skips,
        mountings=mountings,
        camera=camera,
        truth=truth,
        notes=(f'times.txt starts at 0; stamps are {EPOCH_NS // 1_000_000_000} s later',),
    )


def _read_times(path: Path) -> NDArray[np.int64]:
    try:
        text = path.read_text()
    except OSError:
        raise DataError(
            f'{path}: missing, so the scans have no stamps; '
            'it is in the odometry calibration archive'
        ) from None
    try:
        seconds = np.array(text.split(), np.float64)
    except ValueError as error:
        raise DataError(f'{path}: expected one time in seconds a line: {error}') from None
    if not len(seconds) or not np.isfinite(seconds).all():
        raise DataError(f'{path}: expected one time in seconds a line, got none or a NaN')
    return np.rint(seconds * 1e9).astype(np.int64) + EPOCH_NS


def _files_stream(
    kind: type[LidarScan] | type[CameraImage],
    folder: Path,
    files: dict[int, Path],
    times_ns: NDArray[np.int64],
    skips: Skips,
) -> SensorStream:
    timed = [number for number in files if number < len(times_ns)]
    if len(timed) < len(files):
        skips.add(
            f'{folder.name} file without a row in times.txt',
            folder,
            f'{folder}: files reach number {max(files)}, times.txt has {len(times_ns)} rows; '
            f'{len(files) - len(timed)} files are left out',
            len(files) - len(timed),
        )
    if not timed:
        raise DataError(f'{folder}: no file number has a row in times.txt ({len(times_ns)} rows)')

    labels = folder.parent / 'labels'

    def read(entry: int, stamp_ns: int) -> Record:
        if kind is LidarScan:
            cloud = read_float32_cloud(files[entry])
            return LidarScan(stamp_ns, _labelled(cloud, labels / f'{entry:06d}.label', skips))
        return CameraImage(stamp_ns, read_image(files[entry]))

    return make_stream(kind, str(folder), times_ns[timed], timed, read, skips)


def _labelled(cloud: PointCloud, file: Path, skips: Skips) -> PointCloud:
    """Return a sweep with its labels, where it has some that fit."""
    if not file.exists():
        return cloud
    try:
        return replace(cloud, label=read_labels(file, len(cloud)))
    except UnreadableError as error:
        skips.add(error.cause, file, str(error))
        return cloud


def _read_truth(
    folder: Path, times_ns: NDArray[np.int64], T_cam0_lidar: se3.Array, skips: Skips
) -> Trajectory | None:
    candidates = (folder.parent.parent / 'poses' / f'{folder.name}.txt', folder / 'poses.txt')
    path = next((p for p in candidates if p.is_file()), None)
    if path is None:
        return None
    P = read_poses(path)
    rows = min(len(P), len(times_ns))
    if len(P) != len(times_ns):
        skips.add(
            'pose without a time, or time without a pose',
            path,
            f'{path}: {len(P)} poses for {len(times_ns)} times; the first {rows} are used',
            abs(len(P) - len(times_ns)),
        )
    _log.info('ground truth from %s', path)
    T_base_cam0 = base_from_lidar() @ se3.inverse(T_cam0_lidar)
    poses = T_base_cam0 @ P[:rows] @ se3.inverse(T_base_cam0)
    stamps, first = np.unique(times_ns[:rows], return_index=True)
    finite = np.isfinite(poses[first]).all(axis=(1, 2))
    return Trajectory(stamps[finite], poses[first][finite])
