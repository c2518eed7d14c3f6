"""Write a drive in KITTI's layout, so that a peer reads exactly what the suite reads."""

from pathlib import Path

import numpy as np

from bags.records import Drive, LidarScan
from lcd_common import se3
from lcd_common.errors import DataError


def write_kitti_folder(drive: Drive, root: Path) -> Path:
    """Write sequences/00 (velodyne, times, calib) and poses/00.txt; return the sequence folder.

    Tr is the identity: the poses are the LiDAR's, the first one is the identity, as
    tools that read KITTI expect. The drive's LiDAR must be mounted level above base_link at KITTI's
    1.73 m, which is where the reader of KITTI folders puts base_link.

    Raises:
        DataError: the drive has no ground truth or another mounting.
    """
    truth = drive.truth()
    if truth is None:
        raise DataError(f'{drive.name}: expected a drive with ground truth')
    T_base_lidar = next(m.T_parent_child for m in drive.mountings if m.child == 'lidar')
    if not np.allclose(T_base_lidar, se3.from_rotation_translation(np.eye(3), [0, 0, 1.73])):
        raise DataError(f'{drive.name}: expected the LiDAR level at 1.73 m, got {T_base_lidar}')
    sequence = root / 'sequences' / '00'
    (sequence / 'velodyne').mkdir(parents=True, exist_ok=True)
    (root / 'poses').mkdir(exist_ok=True)
    times: list[float] = []
    poses: list[se3.Array] = []
    for record in drive.records():
        if not isinstance(record, LidarScan):
            continue
        T_world_base = truth.at(record.stamp_ns)
        if T_world_base is None:
            continue
        points = np.zeros((len(record.cloud), 4), np.float32)
        points[:, :3] = record.cloud.xyz
        if record.cloud.intensity is not None:
            points[:, 3] = record.cloud.intensity
        points.tofile(sequence / 'velodyne' / f'{len(times):06d}.bin')
        times.append(record.stamp_ns * 1e-9)
        poses.append(T_world_base @ T_base_lidar)
    T_first = se3.inverse(poses[0])
    rows = [(T_first @ T)[:3].ravel() for T in poses]
    np.savetxt(root / 'poses' / '00.txt', rows, fmt='%.9e')
    np.savetxt(sequence / 'times.txt', np.array(times) - times[0], fmt='%.6e')
    identity = ' '.join(f'{v:.12e}' for v in np.eye(4)[:3].ravel())
    names = ('P0', 'P1', 'P2', 'P3', 'Tr')
    (sequence / 'calib.txt').write_text(''.join(f'{name}: {identity}\n' for name in names))
    return sequence
