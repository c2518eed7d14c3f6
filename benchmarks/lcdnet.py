"""Measure LCDNet beside its baselines and write benchmarks/results/lcdnet.json.

    python -m benchmarks.lcdnet                    everything (many hours on two cores)
    python -m benchmarks.lcdnet --only speed real  some sections; the others keep their figures
    python -m benchmarks.lcdnet --quick            one town of three, fewer pairs
    python -m benchmarks.lcdnet --list             the sections and what they measure
    python -m benchmarks.lcdnet --work build/lcdnet  keep sweeps and descriptors for later runs

LCDNET_WEIGHTS names a file of weights; without, those that ship are measured. Sections write what
they can when a method is missing, and say so. Exits with 1 when a section failed or a required
figure is missing.
"""

import sys
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from benchmarks.command import Benchmark, Section, run_benchmark

_DETECTORS = ('lcdnet', 'scan_context', 'm2dp', 'isc', 'lidar_iris')
_REGISTRATIONS = ('lcdnet_fast', 'lcdnet_ransac', 'lcdnet', 'kiss_matcher', 'fpfh_ransac')
REQUIRED = (
    *(
        f'ap.{protocol}.{kind}.{method}'
        for protocol in ('protocol1', 'protocol2')
        for kind in ('same_way', 'reverse')
        for method in _DETECTORS
    ),
    # MapClosures compares maps, not pairs of scans: it has no protocol 2.
    'ap.protocol1.same_way.map_closures',
    'ap.protocol1.reverse.map_closures',
    'ap_sector_45.*',
    'ap_sector_90.*',
    *(
        f'registration.{band}.{figure}.{method}'
        for band in ('0_4', '4_10', '10_15')
        for figure in ('success', 'te_m', 're_deg')
        for method in _REGISTRATIONS
    ),
    'real.kitti_00.pair_translation_error_m',
    'real.kitti_00.pair_rotation_error_deg',
    'real.kitti_00.negatives_rejected',
    'real.out_and_back.*',
    'loops_of_the_nodes.out_and_back.lcdnet.true',
    'loops_of_the_nodes.demonstration.lcdnet.true',
    'descriptor_ms.compact_cpu',
    'descriptor_ms.full_cpu',
    'descriptor_ms.full_gpu',
    'registration_ms',
    'query_ms.18235',
    'query_ms.1000000',
    'keyframe_bytes',
)


def sections(quick: bool = False) -> dict[str, tuple[str, Section]]:
    """Return every section by name: what it measures, and the function that does."""
    # Imported here: --help and --list need none of it.
    from benchmarks import (
        lcdnet_ablations,
        lcdnet_drives,
        lcdnet_loops,
        lcdnet_real,
        lcdnet_registration,
        lcdnet_speed,
    )

    towns, pairs = (1, 60) if quick else (3, 1002)
    return {
        'detection': (
            'average precision on test towns, by both protocols, beside all baselines',
            partial(lcdnet_drives.detection, towns=towns),
        ),
        'map_closures': (
            'the same of MapClosures on shorter drives, with LCDNet and Scan Context beside it',
            partial(lcdnet_drives.map_closures, length_m=400.0)
            if quick
            else lcdnet_drives.map_closures,
        ),
        'changed': (
            'a repeated run with other traffic, and a sensor that training did not see',
            lcdnet_drives.changed,
        ),
        'sectors': (
            'the same on the first town with sectors of the view removed',
            lcdnet_drives.sectors,
        ),
        'registration': (
            'success and errors by distance, beside all baselines',
            partial(lcdnet_registration.registration, towns=towns, pairs=pairs),
        ),
        'initial_guess': (
            'ICP with and without the guess',
            partial(lcdnet_registration.initial_guess, pairs=10 if quick else 60),
        ),
        'real': (
            'places of real sweeps: the out-and-back drive, neighbours',
            lcdnet_real.places,
        ),
        'real_registration': (
            'registration of real sweeps: a pair from any yaw, different places',
            partial(lcdnet_real.pairs, sweep_step=10 if quick else 1),
        ),
        'loops': (
            'loops that the nodes accept, LCDNet beside Scan Context',
            lcdnet_loops.evaluate,
        ),
        'ablations': (
            'variants of the network, trained alike and briefly: Tables 3.8 and 3.9',
            partial(lcdnet_ablations.ablations, steps=10) if quick else lcdnet_ablations.ablations,
        ),
        'speed': ('times by stage, and how they grow', lcdnet_speed.evaluate),
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    return run_benchmark(Benchmark('lcdnet', __doc__ or '', sections, REQUIRED, _placed), argv)


def _placed(figures: dict[str, Any], section: str, new: dict[str, Any]) -> Mapping[str, Any]:
    """Put a section's figures at the top, by their names; what a later run adds stays beside."""
    if section in ('detection', 'map_closures', 'real', 'real_registration'):
        return {**figures, **{k: _joined(figures.get(k, {}), v) for k, v in new.items()}}
    return {**figures, **new}


def _joined(old: Any, new: Any) -> Any:
    if not isinstance(old, Mapping) or not isinstance(new, Mapping):
        return new
    return {**old, **{key: _joined(old.get(key), value) for key, value in new.items()}}


if __name__ == '__main__':
    sys.exit(main())
