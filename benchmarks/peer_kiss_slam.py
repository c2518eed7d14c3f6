"""Run KISS-SLAM on a KITTI folder; the peers' own Python does, so nothing of ours is imported.

    python peer_kiss_slam.py SEQUENCE_FOLDER OUT.json [max_range] [min_range]

OUT.json: poses (3x4 rows of the LiDAR), odometry-only poses of the same run's configuration,
closures with their constraints' scan indices, seconds per scan.
"""

import contextlib
import io
import json
import sys
import time
from pathlib import Path

import numpy as np
from kiss_icp.kiss_icp import KissICP
from kiss_slam.config import load_config
from kiss_slam.slam import KissSLAM


def main() -> None:
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    settings = load_config(None)
    settings.odometry.preprocessing.deskew = False
    if len(sys.argv) > 4:
        settings.odometry.preprocessing.max_range = float(sys.argv[3])
        settings.odometry.preprocessing.min_range = float(sys.argv[4])
        settings.odometry.mapping.voxel_size = float(sys.argv[3]) / 100.0
    slam, odometry = KissSLAM(settings), KissICP(settings.kiss_icp_config())
    scans = sorted((folder / 'velodyne').glob('*.bin'))
    seconds, odometry_poses, closures = [], [], []
    local_map_scans: list[list[int]] = [[0]]
    for number, path in enumerate(scans):
        points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3].astype(np.float64)
        no_time = np.array([])
        start = time.perf_counter()
        with contextlib.redirect_stdout(io.StringIO()):
            slam.process_scan(points, no_time)
        seconds.append(time.perf_counter() - start)
        odometry.register_frame(points, no_time)
        odometry_poses.append(odometry.last_pose.copy())
        local_map_scans[-1].append(number)
        if slam.local_map_graph.last_id >= len(local_map_scans):
            local_map_scans.append([number])
    with contextlib.redirect_stdout(io.StringIO()):
        slam.generate_new_node()
        slam.local_map_graph.erase_last_local_map()
        poses, _ = slam.fine_grained_optimization()
    for source, target in slam.get_closures():
        maps = slam.local_map_graph
        closures.append(
            {
                'source_scan': local_map_scans[source][0],
                'target_scan': local_map_scans[target][0],
                'T_source_target': (
                    np.linalg.inv(maps[source].keypose) @ maps[target].keypose
                ).tolist(),
            }
        )
    out.write_text(
        json.dumps(
            {
                'poses': [np.asarray(T)[:3].ravel().tolist() for T in poses],
                'odometry_poses': [T[:3].ravel().tolist() for T in odometry_poses],
                'closures': closures,
                'seconds_per_scan': seconds,
            }
        )
    )


if __name__ == '__main__':
    main()
