"""Write a simulated drive as a sequence of KITTI's odometry benchmark, with SemanticKITTI's labels.

ROOT/sequences/NN/{velodyne/NNNNNN.bin, labels/NNNNNN.label, image_2/NNNNNN.png, calib.txt,
                   times.txt, poses.txt}
ROOT/poses/NN.txt
"""

import shutil
from pathlib import Path

import numpy as np
from PIL import Image
from tqdm import tqdm

from bags.simulation import car
from bags.simulation.drive import SimulatedDrive
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory


def write_kitti(
    drive: SimulatedDrive, root: Path, sequence: str, *, overwrite: bool = False, progress: bool
) -> dict[str, int]:
    """Write a drive; return the number of files of each folder.

    It appears under its name when it is complete.

    Args:
        drive: what to write; IMU and satellites have no place in this layout.
        root: of the data set; made when it is not there, but not its parents.
        sequence: name of the sequence, e.g. '00'.
        overwrite: replace a sequence of that name.
        progress: show a bar on stderr.

    Raises:
        DataError: the sequence exists, the folder above `root` does not, or the disk fails.
    """
    folder = root / 'sequences' / sequence
    if not root.parent.is_dir():
        raise DataError(f'{root}: the folder {root.parent} does not exist; create it first')
    if folder.exists() and not overwrite:
        raise DataError(f'{folder}: exists; choose another folder or give --overwrite')
    partial = folder.with_name(f'.{sequence}.partial')
    try:
        shutil.rmtree(partial, ignore_errors=True)
        counts = _write(drive, partial, progress)
        shutil.rmtree(folder, ignore_errors=True)
        partial.rename(folder)
        (root / 'poses').mkdir(exist_ok=True)
        shutil.copyfile(folder / 'poses.txt', root / 'poses' / f'{sequence}.txt')
    except OSError as error:
        raise DataError(f'{folder}: cannot write: {error.strerror}; check the folder') from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return counts


def _write(drive: SimulatedDrive, folder: Path, progress: bool) -> dict[str, int]:
    names = ['velodyne', 'labels'] + (['image_2'] if drive.camera is not None else [])
    for name in names:
        (folder / name).mkdir(parents=True)
    truth = drive.truth()
    for index in tqdm(range(len(truth)), unit='scan', disable=not progress):
        sweep = drive.sweep(index)
        intensity = sweep.cloud.intensity
        if intensity is None:
            intensity = np.zeros(len(sweep.cloud), np.float32)
        points = np.column_stack([sweep.cloud.xyz, intensity]).astype(np.float32)
        points.tofile(folder / 'velodyne' / f'{index:06d}.bin')
        sweep.label.astype(np.uint32).tofile(folder / 'labels' / f'{index:06d}.label')
        if drive.camera is not None:
            image = Image.fromarray(drive.image(index).pixels)
            image.save(folder / 'image_2' / f'{index:06d}.png', compress_level=3)
    seconds = (truth.stamps_ns - truth.stamps_ns[0]) * 1e-9
    (folder / 'times.txt').write_text(''.join(f'{t:.6e}\n' for t in seconds))
    rows = {'P0': car.P0, 'P1': car.P0, 'P2': car.P2, 'P3': car.P2, 'Tr': car.T_CAM0_LIDAR[:3]}
    text = [f'{k}: {" ".join(f"{v:.12e}" for v in rows[k].ravel())}\n' for k in rows]
    (folder / 'calib.txt').write_text(''.join(text))
    _in_camera_0(truth).write_kitti(folder / 'poses.txt')
    return dict.fromkeys(names, len(truth))


def _in_camera_0(truth: Trajectory) -> Trajectory:
    """Express base_link's trajectory as KITTI does: camera 0 in the frame of its first pose."""
    T_base_cam0 = car.LIDAR.T_parent_child @ se3.inverse(car.T_CAM0_LIDAR)
    T_world_first = truth.T_world_body[0] @ T_base_cam0
    return truth.in_frame(se3.inverse(T_world_first), T_base_cam0)
