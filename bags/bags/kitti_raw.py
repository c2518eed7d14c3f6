"""Read KITTI's raw recordings, synchronised and rectified (sync) or as recorded (extract).

    DATE/calib_{cam_to_cam,velo_to_cam,imu_to_velo}.txt
    DATE/DATE_drive_NNNN_{sync,extract}/{velodyne_points,image_02,oxts}/{data/NNNNNNNNNN.*,timestamps.txt}

Line n of a timestamps.txt belongs to file n. A sweep is stamped with timestamps.txt, the moment at
which the laser faces forward and triggers the cameras (without it: halfway between
timestamps_start.txt and timestamps_end.txt). Sweeps are not motion compensated and carry no point
time. extract has sweeps as text and images before rectification.
"""

from pathlib import Path

from bags.calibration_file import CalibrationFile
from bags.folder_drive import FolderDrive
from bags.kitti_car import base_from_lidar, camera_of_projection, mounted
from bags.numbered_files import (
    image_size,
    numbered_files,
    read_float32_cloud,
    read_image,
    read_text_cloud,
)
from bags.oxts import read_oxts
from bags.records import CameraImage, CameraModel, LidarScan, Mounting, Record
from bags.sensor_stream import SensorStream, make_stream
from bags.skips import Skips
from bags.stamp_files import read_date_stamps, stamps_of_numbers
from lcd_common import se3
from lcd_common.errors import DataError

_CAMERAS = ('02', '00')  # colour before grey


def is_kitti_raw(path: Path) -> bool:
    """Tell whether a folder is a drive, or a date with drives in it."""
    return (path / 'velodyne_points').is_dir() or bool(_drives(path))


def open_kitti_raw(path: Path, sequence: str | None = None) -> FolderDrive:
    """Open a drive, given its folder or its date's and the drive's name or a part of it (0027).

    Raises:
        DataError: no or several drives fit, the sweeps or their stamps are missing, or a
            calibration file cannot be read.
    """
    folder, skips = _find_drive(path, sequence), Skips()
    streams = [_scans(folder / 'velodyne_points', skips)]
    mountings: tuple[Mounting, ...] = (mounted('lidar', se3.exp([0.0] * 6)),)
    T_cam0_lidar = _transform(folder, 'calib_velo_to_cam.txt', 'no camera', skips)
    camera = None
    if T_cam0_lidar is not None and (folder.parent / 'calib_cam_to_cam.txt').is_file():
        calibration = CalibrationFile(folder.parent / 'calib_cam_to_cam.txt')
        for number in _CAMERAS:
            found = _camera(folder, calibration, number, T_cam0_lidar, skips)
            if found is not None:
                camera, mounting, stream = found
                mountings += (mounting,)
                streams.append(stream)
                break
    oxts, truth = read_oxts(folder / 'oxts', skips), None
    if oxts is not None:
        streams += oxts.streams(skips)
        T_lidar_imu = _transform(folder, 'calib_imu_to_velo.txt', 'no ground truth', skips)
        if T_lidar_imu is not None:
            # The fix is the INS's solution at its own origin, not at the antenna.
            mountings += (mounted('imu', T_lidar_imu), mounted('gps', T_lidar_imu))
            truth = oxts.trajectory(se3.inverse(base_from_lidar() @ T_lidar_imu))
    return FolderDrive(
        f'kitti_raw_{folder.name}',
        folder,
        streams,
        skips,
        mountings=mountings,
        camera=camera,
        truth=truth,
        notes=('ground truth is the OXTS solution, the source of the GNSS and twist records',),
    )


def _drives(path: Path) -> list[str]:
    return sorted(
        p.name
        for p in path.glob('*_drive_*')
        if p.name.endswith(('_sync', '_extract')) and (p / 'velodyne_points').is_dir()
    )


def _find_drive(path: Path, sequence: str | None) -> Path:
    if (path / 'velodyne_points').is_dir():
        return path
    names = _drives(path)
    fitting = [name for name in names if sequence is None or sequence in name]
    if len(fitting) == 1:
        return path / fitting[0]
    asked = 'choose a drive' if sequence is None else f'{len(fitting)} drives fit {sequence!r}'
    raise DataError(f'{path}: {asked}; it has {", ".join(names) or "none"}')


def _scans(folder: Path, skips: Skips) -> SensorStream:
    files = numbered_files(folder / 'data', ('.bin', '.txt'), skips)
    if not files:
        raise DataError(f'{folder / "data"}: no scans NNNNNNNNNN.bin (or .txt) in it')
    path = folder / 'timestamps.txt'
    if path.is_file():
        stamps = stamps_of_numbers(list(files), read_date_stamps(path), path, skips)
    else:
        stamps = _middle_stamps(folder, list(files), skips)
    if not stamps:
        raise DataError(f'{path}: no scan has a stamp')

    def read(entry: int, stamp_ns: int) -> Record:
        file = files[entry]
        cloud = read_text_cloud(file) if file.suffix == '.txt' else read_float32_cloud(file)
        return LidarScan(stamp_ns, cloud)

    return make_stream(LidarScan, str(folder), list(stamps.values()), list(stamps), read, skips)


def _middle_stamps(folder: Path, numbers: list[int], skips: Skips) -> dict[int, int]:
    edges = [folder / 'timestamps_start.txt', folder / 'timestamps_end.txt']
    if not all(edge.is_file() for edge in edges):
        raise DataError(f'{folder / "timestamps.txt"}: missing, so the scans have no stamps')
    skips.note(f'{folder / "timestamps.txt"}: missing; scans get the middle of start and end')
    start, end = (stamps_of_numbers(numbers, read_date_stamps(e), e, skips) for e in edges)
    return {n: (start[n] + end[n]) // 2 for n in numbers if n in start and n in end}


def _camera(
    folder: Path, calibration: CalibrationFile, number: str, T_cam0_lidar: se3.Array, skips: Skips
) -> tuple[CameraModel, Mounting, SensorStream] | None:
    images_folder = folder / f'image_{number}'
    files = numbered_files(images_folder / 'data', ('.png', '.jpg'), skips)
    size = image_size(list(files.values()))
    if size is None:
        return None
    path = images_folder / 'timestamps.txt'
    stamps = stamps_of_numbers(list(files), read_date_stamps(path), path, skips)
    if folder.name.endswith('_extract'):
        K = calibration.matrix(f'K_{number}', 3, 3)
        k1, k2, p1, p2, k3 = calibration.matrix(f'D_{number}', 1, 5)[0].tolist()
        camera = CameraModel('camera', size[0], size[1], K, (k1, k2, p1, p2, k3))
        T_cam_lidar = calibration.rotation_translation(f'_{number}') @ T_cam0_lidar
    else:
        camera, T_cam_rect0 = camera_of_projection(calibration, f'P_rect_{number}', size)
        R_rect = se3.from_rotation_translation(calibration.rotation('R_rect_00'), [0.0, 0.0, 0.0])
        T_cam_lidar = T_cam_rect0 @ R_rect @ T_cam0_lidar

    def read(entry: int, stamp_ns: int) -> Record:
        return CameraImage(stamp_ns, read_image(files[entry]))

    source = str(images_folder)
    stream = make_stream(CameraImage, source, list(stamps.values()), list(stamps), read, skips)
    return camera, mounted('camera', se3.inverse(T_cam_lidar)), stream


def _transform(folder: Path, name: str, without: str, skips: Skips) -> se3.Array | None:
    path = folder.parent / name
    if path.is_file():
        return CalibrationFile(path).rotation_translation()
    skips.add(
        f'{name} missing: {without}',
        path,
        f"{path}: missing, so there is {without}; it is in the date's calibration archive",
    )
    return None
