"""Measure CMRNet with uncertainty and its EKF; write benchmarks/results/cmrnet_ekf.json.

    python -m benchmarks.cmrnet_ekf                        everything
    python -m benchmarks.cmrnet_ekf --only consistency     some sections; the others keep theirs
    python -m benchmarks.cmrnet_ekf --quick                fewer runs
    python -m benchmarks.cmrnet_ekf --list                 the sections and what they measure
    python -m benchmarks.cmrnet_ekf --work build/ekf       keep samples, maps, tracks and pictures

CMRNET_WEIGHTS names the folder of trained networks, one for each role: cmrnet, mcd, de, der; a role
that is missing is left out. What else is there (nll, covariance) is judged beside them, and
second/<role> and third/<role> refine in stages. A role is a .safetensors file, a folder of
train_cmrnet, or, as an ensemble, a folder of such. What the work folder holds is not made again:
with it, consistency is also measured with the errors that the networks of ekf made in all stages.
Exits with 1 when a section failed or a required figure is missing.
"""

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from benchmarks.command import Benchmark, Section, run_benchmark

_UNCERTAIN = ('mcd', 'de', 'der')
REQUIRED = (
    *(
        f'localization.{method}.{figure}'
        for method in ('rough', 'cmrnet', *_UNCERTAIN)
        for figure in ('t_median_m', 't_mean_m', 'r_median_deg', 'failures_1m')
    ),
    *(
        f'calibration.{method}.{axis}'
        for method in _UNCERTAIN
        for axis in ('x', 'y', 'z', 'roll', 'pitch', 'yaw')
    ),
    *(
        f'rejection.{method}.{figure}'
        for method in _UNCERTAIN
        for figure in ('t_mean_m', 'discarded_share')
    ),
    *(
        f'ekf.{method}.{figure}'
        for method in ('motion', 'unfiltered', *_UNCERTAIN)
        for figure in ('t_max_m', 't_mean_m', 't_median_m', 'r_median_deg')
    ),
    'consistency.anees_inside_share',
    'consistency.anees_mean',
    'consistency.nis_camera',
    'consistency.nis_gnss',
    'consistency.recovered',
    'real.kitti_00.*',
    'real.kitti_360.*',
    'imu_hz',
    'lidar_image_ms',
    'step_hz.compact_cpu',  # step_hz.full_gpu is null without a GPU
    'mcd_cost_ratio',
)


def sections(quick: bool = False) -> dict[str, tuple[str, Section]]:
    """Return every section by name: what it measures, and the function that does."""
    # Imported here: --help and --list need none of it.
    from benchmarks import (
        cmrnet_methods,
        cmrnet_real,
        cmrnet_speed,
        cmrnet_tracking,
        ekf_consistency,
        ekf_kitti,
    )

    return {
        'localization': (
            'errors of CMRNet and its uncertain variants on test towns, single pass and in stages',
            partial(cmrnet_methods.localization, quick=quick),
        ),
        'calibration': (
            'how true their uncertainties are, on the same samples',
            partial(cmrnet_methods.calibration, quick=quick),
        ),
        'rejection': (
            'what is left when the most uncertain are rejected, on the same samples',
            partial(cmrnet_methods.rejection, quick=quick),
        ),
        'ekf': (
            "closed loop: motion model, no filter, the vehicle's and the thesis's EKF by network",
            partial(cmrnet_tracking.evaluate, quick=quick),
        ),
        'consistency': (
            'the EKF over Monte-Carlo runs: ANEES, NIS, autocorrelation, recovery, speed',
            partial(ekf_consistency.section, runs=10) if quick else ekf_consistency.section,
        ),
        'real_kitti_00': (
            'real IMU and GPS of KITTI 00 with outages, beside no biases and GTSAM',
            ekf_kitti.section,
        ),
        'real_kitti_360': (
            'real images of one street, before and after fine-tuning on its beginning',
            partial(cmrnet_real.evaluate, quick=quick),
        ),
        'speed': (
            'LiDAR image, steps of the networks, MC dropout, memory',
            partial(cmrnet_speed.evaluate, quick=quick),
        ),
    }


def place(figures: dict[str, Any], section: str, new: dict[str, Any]) -> Mapping[str, Any]:
    """Put a section's figures among those there are."""
    if section.startswith('real_'):
        return {**figures, 'real': {**figures.get('real', {}), section[5:]: new}}
    if section in ('consistency', 'speed'):  # these name their figures themselves
        return {**figures, **new}
    return {**figures, section: new}


COMMAND = Benchmark('cmrnet_ekf', __doc__ or '', sections, REQUIRED, place)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    return run_benchmark(COMMAND, argv)


if __name__ == '__main__':
    sys.exit(main())
