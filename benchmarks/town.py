"""Measure the simulator and write benchmarks/results/town.json.

    python -m benchmarks.town                     everything (most of an hour on two cores)
    python -m benchmarks.town --only speed        some sections; the others keep their figures
    python -m benchmarks.town --quick             shorter drives
    python -m benchmarks.town --list              the sections and what they measure

Exits with 1 when a section failed or a required figure is missing.
"""

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from benchmarks.command import Benchmark, Section, run_benchmark

REQUIRED = (
    'sweeps_per_second_cpu',
    'camera_frames_per_second_cpu',
    'kiss_icp_drift_percent',
    'real_vs_sim.*',
    'scan_context_ap.same_way',
    'scan_context_ap.reverse',
    'renderers_within_1cm_share',
    'live_10hz.odometry_lost',
    'live_10hz.odometry_latency_p99_ms',
)


def sections(quick: bool = False) -> dict[str, tuple[str, Section]]:
    """Return every section by name: what it measures, and the function that does."""
    # Imported here: --help and --list need none of it.
    from benchmarks import realism, simulated_drives, simulation_speed

    return {
        'speed': ('sweeps and camera frames a second', simulation_speed.evaluate),
        'renderers': ('Embree and torch, ray by ray', simulation_speed.renderers),
        'realism': ('real sweeps beside simulated ones', realism.evaluate),
        'scan_context': (
            'how hard the test towns are: Scan Context by protocol 1',
            partial(simulated_drives.scan_context, towns=1) if quick
            else simulated_drives.scan_context,
        ),
        'kiss_icp': (
            'drift of KISS-ICP on simulated drives',
            partial(simulated_drives.kiss_icp, towns=1) if quick else simulated_drives.kiss_icp,
        ),
        'kiss_slam': (
            'a simulated drive: the suite beside KISS-SLAM',
            partial(simulated_drives.kiss_slam, length_m=300.0) if quick
            else simulated_drives.kiss_slam,
        ),
        'live_10hz': (
            'a simulated drive at 1x through DDS',
            partial(simulated_drives.live, seconds=120.0) if quick else simulated_drives.live,
        ),
    }  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    return run_benchmark(Benchmark('town', __doc__ or '', sections, REQUIRED, _placed), argv)


def _placed(figures: dict[str, Any], section: str, new: dict[str, Any]) -> Mapping[str, Any]:
    """Put a section's figures where the result tables expect them: at the top, by their names."""
    del section
    return {**figures, **new}


if __name__ == '__main__':
    sys.exit(main())
