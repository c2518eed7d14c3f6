"""Run MapClosures on a KITTI folder; the peers' own Python does, so nothing of ours is imported.

    python peer_map_closures.py SEQUENCE_FOLDER OUT.json WINDOW_M STRIDE_M EXCLUDED_SCANS

A local map is made of the sweeps of the last WINDOW_M of path, placed by the poses of the folder,
at every STRIDE_M. OUT.json: for each map its last scan, seconds to compare it with those before,
and the closures with maps at least EXCLUDED_SCANS older, most inliers first: the last scan of that
map, inliers, and the pose of the newer map in it.
"""

import json
import sys
import time
from collections import deque
from pathlib import Path

import numpy as np
from map_closures.config import load_config
from map_closures.map_closures import MapClosures
from map_closures.voxel_map import VoxelMap

_RANGE_M = 100.0  # the package's own


def main() -> None:
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    window_m, stride_m, excluded = float(sys.argv[3]), float(sys.argv[4]), int(sys.argv[5])
    rows = np.loadtxt(folder.parent.parent / 'poses' / f'{folder.name}.txt').reshape(-1, 3, 4)
    T_world_lidar = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_lidar[:, :3] = rows
    steps = np.linalg.norm(np.diff(T_world_lidar[:, :3, 3], axis=0), axis=1)
    travelled_m = np.concatenate([[0.0], np.cumsum(steps)])
    settings = load_config(None)
    detector, voxel_m = MapClosures(settings), settings.density_map_resolution
    sweeps: deque[tuple[int, np.ndarray]] = deque()
    maps: list[dict] = []
    for number, path in enumerate(sorted((folder / 'velodyne').glob('*.bin'))):
        points = np.fromfile(path, np.float32).reshape(-1, 4)[:, :3].astype(np.float64)
        # Thinned once, so that a sweep costs little in each of the maps it is part of.
        sweeps.append((number, _thinned(points, voxel_m)))
        while travelled_m[number] - travelled_m[sweeps[0][0]] > window_m:
            sweeps.popleft()
        if maps and travelled_m[number] - travelled_m[maps[-1]['scan']] < stride_m:
            continue
        local = VoxelMap(voxel_m, _RANGE_M)
        for other, thinned in sweeps:
            local.integrate_frame(
                thinned, np.linalg.inv(T_world_lidar[number]) @ T_world_lidar[other]
            )
        start = time.perf_counter()
        closures = detector.get_top_k_closures(number, local.point_cloud(), len(maps) + 1)
        maps.append(
            {
                'scan': number,
                'seconds': time.perf_counter() - start,
                'closures': [
                    {
                        'scan': closure.source_id,
                        'inliers': closure.number_of_inliers,
                        'T_match_query': np.linalg.inv(closure.pose).tolist(),
                    }
                    for closure in closures
                    if number - closure.source_id > excluded
                ],
            }
        )
    out.write_text(json.dumps(maps))


def _thinned(points: np.ndarray, voxel_m: float) -> np.ndarray:
    sweep = VoxelMap(voxel_m, _RANGE_M)
    sweep.integrate_frame(points, np.eye(4))
    return np.asarray(sweep.point_cloud())


if __name__ == '__main__':
    main()
