"""Judge MapClosures by protocol 1: which earlier scan each scan shows, by its closures of maps.

Gupta et al., "Effectively Detecting Loop Closures using Point Cloud Density Maps", ICRA 2024.
"""

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import peers
from benchmarks.recordings import ROOT
from lcd_common import se3
from lcd_loop_closure.evaluation.detection_protocols import Candidates, joined
from lcd_loop_closure.revisits import RevisitConfig

WINDOW_M = 5.0  # of path in a local map: the best of 0, 5, 10 and 30 m on validation towns
STRIDE_M = 5.0  # of path between local maps


@dataclass(frozen=True)
class MapClosure:
    """The best closure of a local map.

    Attributes:
        match: last scan of the older map; None where none was found.
        inliers: keypoints that agree, 0 without a closure.
        T_match_query: pose of the newer map's last scan in that of the older one, LiDAR frames.
    """

    match: int | None
    inliers: int
    T_match_query: se3.Array | None


@dataclass(frozen=True)
class MapClosuresRun:
    """What MapClosures found on a drive.

    Attributes:
        scan: [M] last scan of each local map.
        seconds: [M] to describe a map and compare it with all before.
        best: M closures.
    """

    scan: NDArray[np.intp]
    seconds: NDArray[np.float64]
    best: tuple[MapClosure, ...]


def map_closures(
    sequence: Path,
    work: Path,
    *,
    window_m: float = WINDOW_M,
    stride_m: float = STRIDE_M,
    excluded_scans: int = 50,
) -> MapClosuresRun:
    """Run MapClosures with its defaults on a KITTI sequence folder, placing sweeps by its poses.

    Raises:
        PeerError: it failed; the message holds the end of what it printed.
    """
    out = work / f'map_closures_{sequence.parent.parent.name}.json'
    command = [
        str(peers.python()),
        str(ROOT / 'benchmarks' / 'peer_map_closures.py'),
        str(sequence),
        str(out),
        str(window_m),
        str(stride_m),
        str(excluded_scans),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise peers.PeerError(f'MapClosures failed on {sequence}: {done.stderr[-500:]}')
    return read_run(out)


def read_run(path: Path) -> MapClosuresRun:
    """Read what peer_map_closures.py wrote."""
    maps = json.loads(path.read_text())
    return MapClosuresRun(
        scan=np.array([m['scan'] for m in maps], np.intp),
        seconds=np.array([m['seconds'] for m in maps]),
        best=tuple(_best(m['closures']) for m in maps),
    )


def judged(
    run: MapClosuresRun, T_world_lidar: se3.Array, settings: RevisitConfig | None = None
) -> Candidates:
    """Return the candidate of each scan, its distance minus the inliers, for `protocol_1`.

    A scan takes the closure of the last map before it, which counts up to half an inlier less the
    longer ago that was: equal distances would be accepted together, and protocol 1 leaves the first
    ones accepted out of the average. The candidate is not that map's own scan but
    the one nearest to where the closure puts the query, on the path around the older map: maps
    overlap over tens of metres, scans of one place must lie within four. Without a closure the
    distance is infinite, which protocol 1 never accepts.

    Args:
        run: of MapClosures.
        T_world_lidar: [N x 4 x 4] poses of the scans.
        settings: which scans count.
    """
    s = settings or RevisitConfig()
    positions = T_world_lidar[:, :3, 3]
    rows = []
    for query in range(max(s.first_scan, s.excluded_scans + 1), len(positions)):
        earlier = query - s.excluded_scans
        away = np.linalg.norm(positions[:earlier] - positions[query], axis=1)
        of_map = int(np.searchsorted(run.scan, query, side='right')) - 1
        closure = run.best[of_map]
        candidate, distance = 0, np.inf
        if closure.match is not None and closure.T_match_query is not None:
            T_map_query = se3.inverse(T_world_lidar[run.scan[of_map]]) @ T_world_lidar[query]
            T_world_query = T_world_lidar[closure.match] @ closure.T_match_query @ T_map_query
            candidate = _nearest_on_path(positions[:earlier], closure.match, T_world_query[:3, 3])
            since = (query - run.scan[of_map]) / max(int(np.diff(run.scan).max(initial=1)), 1)
            distance = -float(closure.inliers) + 0.5 * min(float(since), 1.0)
        near = away <= s.distance
        right = bool(near[candidate]) and bool(np.isfinite(distance))
        rows.append((query, candidate, distance, right, bool(near.any())))
    return joined(rows)


def _nearest_on_path(
    positions: NDArray[np.float64], around: int, at: NDArray[np.float64], reach: int = 100
) -> int:
    """Return the scan nearest to a place among those up to `reach` scans before or after one."""
    first = max(around - reach, 0)
    part = positions[first : around + reach + 1]
    return first + int(np.argmin(np.linalg.norm(part - at, axis=1)))


def _best(closures: list[dict[str, object]]) -> MapClosure:
    if not closures:
        return MapClosure(None, 0, None)
    best = max(closures, key=lambda closure: int(str(closure['inliers'])))
    return MapClosure(
        int(str(best['scan'])), int(str(best['inliers'])), np.array(best['T_match_query'])
    )
