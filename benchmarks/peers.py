"""Run the peers in an environment of their own, on the same folders as the suite."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.recordings import ROOT
from lcd_common import se3
from lcd_common.errors import LocalizationError

ENVIRONMENT = ROOT / '.venv-peers'


class PeerError(LocalizationError):
    """A peer could not be installed or did not finish."""


@dataclass(frozen=True)
class KissSlamRun:
    """What KISS-SLAM made of a drive: LiDAR poses [N x 4 x 4], closures, seconds per scan [N]."""

    T_map_lidar: se3.Array
    T_odom_lidar: se3.Array
    closures: list[tuple[int, int, se3.Array]]
    seconds: NDArray[np.float64]


def python() -> Path:
    """Return the peers' Python, installing their environment the first time (2 minutes).

    Raises:
        PeerError: the installation failed.
    """
    executable = Path(os.environ.get('PEERS_PYTHON', ENVIRONMENT / 'bin' / 'python'))
    if executable.is_file():
        return executable
    try:
        subprocess.run([sys.executable, '-m', 'venv', str(ENVIRONMENT)], check=True)
        requirements = ROOT / 'requirements' / 'peers.txt'
        subprocess.run(
            [str(executable), '-m', 'pip', 'install', '-q', '-r', str(requirements)], check=True
        )
    except subprocess.CalledProcessError as error:
        raise PeerError(f'the peers could not be installed: {error}') from None
    return executable


def kiss_slam(sequence: Path, work: Path, max_range_m: float, min_range_m: float) -> KissSlamRun:
    """Run KISS-SLAM with its defaults (deskew off) on a KITTI sequence folder.

    Raises:
        PeerError: it failed; the message holds the end of what it printed.
    """
    out = work / f'kiss_slam_{sequence.parent.parent.name}.json'
    script = ROOT / 'benchmarks' / 'peer_kiss_slam.py'
    command = [
        str(python()),
        str(script),
        str(sequence),
        str(out),
        str(max_range_m),
        str(min_range_m),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode != 0:
        raise PeerError(f'KISS-SLAM failed on {sequence}: {done.stderr[-500:]}')
    result = json.loads(out.read_text())
    return KissSlamRun(
        T_map_lidar=_poses(result['poses']),
        T_odom_lidar=_poses(result['odometry_poses']),
        closures=[
            (c['source_scan'], c['target_scan'], np.array(c['T_source_target']))
            for c in result['closures']
        ],
        seconds=np.array(result['seconds_per_scan']),
    )


def _poses(rows: list[list[float]]) -> se3.Array:
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = np.array(rows).reshape(-1, 3, 4)
    return poses
