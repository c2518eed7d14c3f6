"""Measure CMRNet with uncertainty and its EKF; write benchmarks/results/cmrnet_ekf.json.

    python -m benchmarks.cmrnet_ekf                        everything
    python -m benchmarks.cmrnet_ekf --only consistency     some sections; the others keep theirs
    python -m benchmarks.cmrnet_ekf --quick                fewer runs
    python -m benchmarks.cmrnet_ekf --list                 the sections and what they measure
    python -m benchmarks.cmrnet_ekf --work build/ekf       keep tracks and pictures

Exits with 1 when a section failed or a required figure is missing.
"""

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from benchmarks.command import Benchmark, Section, run_benchmark

REQUIRED = (
    'consistency.anees_inside_share',
    'consistency.anees_mean',
    'consistency.nis_camera',
    'consistency.nis_gnss',
    'consistency.recovered',
    'real.kitti_00.*',
    'imu_hz',
)


def sections(quick: bool = False) -> dict[str, tuple[str, Section]]:
    """Return every section by name: what it measures, and the function that does."""
    # Imported here: --help and --list need none of it.
    from benchmarks import ekf_consistency, ekf_kitti

    runs = 10 if quick else 50
    return {
        'consistency': (
            'the EKF over Monte-Carlo runs: ANEES, NIS, autocorrelation, recovery, speed',
            partial(ekf_consistency.section, runs=runs),
        ),
        'real_kitti_00': (
            'real IMU and GPS of KITTI 00 with outages, beside no biases and GTSAM',
            ekf_kitti.section,
        ),
    }


def place(figures: dict[str, Any], section: str, new: dict[str, Any]) -> Mapping[str, Any]:
    """Put a section's figures among those there are."""
    if section.startswith('real_'):
        return {**figures, 'real': {**figures.get('real', {}), section[5:]: new}}
    if section == 'consistency':
        return {**figures, **new}
    return {**figures, section: new}


COMMAND = Benchmark('cmrnet_ekf', __doc__ or '', sections, REQUIRED, place)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    return run_benchmark(COMMAND, argv)


if __name__ == '__main__':
    sys.exit(main())
