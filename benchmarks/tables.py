"""Write the READMEs' result tables from benchmarks/results/*.json: no number is copied by hand.

A table stands in README.md or benchmarks/README.md between `<!-- table:NAME -->` and
`<!-- end -->`.
"""

import argparse
import json
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.lcdnet_tables import LCDNET_TABLES
from benchmarks.localization_tables import LOCALIZATION_TABLES
from benchmarks.place_tables import PLACE_TABLES
from benchmarks.result_table import Row, Table
from benchmarks.town_tables import TOWN_TABLES
from lcd_common.command_line import run
from lcd_common.errors import DataError

ROOT = Path(__file__).resolve().parents[1]
READMES = (ROOT / 'README.md', ROOT / 'benchmarks' / 'README.md')
_BLOCK = re.compile(r'(<!-- table:([\w-]+) -->\n)(.*?)(<!-- end -->)', re.DOTALL)

TABLES: dict[str, Table] = {
    **TOWN_TABLES,
    **LCDNET_TABLES,
    **PLACE_TABLES,
    **LOCALIZATION_TABLES,
    'drive': Table('drive', (
        Row('Real out-and-back drive, live at 1x: scans that odometry lost', '{:.0f}',
            ('out_and_back.odometry_lost',), '0'),
        Row('— odometry latency, median / 99 %', '{:.0f} / {:.0f} ms',
            ('out_and_back.odometry_latency_p50_ms', 'out_and_back.odometry_latency_p99_ms'),
            '≤ 70 / 200 ms'),
        Row('— keyframes of the way back with an accepted loop', '{:.0f} %',
            ('out_and_back.loops_found_share',), '≥ 80 %', 100),
        Row('— accepted loops off by more than 1 m or 3°', '{:.0f}',
            ('out_and_back.loops_wrong',), '0'),
        Row('— end error, corrected', '{:.2f} m', ('out_and_back.end_error_m',), '≤ 0.2 m'),
        Row('— lock-step replay', '{:.1f} × real time',
            ('out_and_back.lockstep_realtime_factor',), '≥ 2 ×'),
        Row('KITTI 00, scans 52 / 4501: error of the loop, worst of 20 yaws', '{:.2f} m, {:.2f}°',
            ('kitti_00.pair_translation_error_m', 'kitti_00.pair_rotation_error_deg'),
            '≤ 0.35 m, 0.6°'),
        Row('— pairs of different places rejected', '{:.0f} of {:.0f}',
            ('kitti_00.negatives_rejected', 'kitti_00.negatives'), 'all'),
        Row('KITTI 08, revisits counted: loops / pairs', '{:.0f} / {:.0f}',
            ('kitti_08.loops', 'kitti_08.pairs'), '334 / 2960'),
        Row('False loops added to graphs: ATE against the clean solve, worst', '{:.3f} ×',
            ('false_loops.worst_ate_ratio',), '≤ 1.05 ×'),
        Row('— true loops kept', '{:.1f} %', ('false_loops.true_kept_share',), '≥ 95 %', 100),
        Row('— wrong loops accepted', '{:.0f}', ('false_loops.wrong_accepted',), '0'),
        Row('U-turn that breaks odometry: ATE, ours / KISS-SLAM', '{:.2f} / {:.2f} m',
            ('u_turn.ate_m', 'u_turn.kiss_slam_ate_m'), 'below the peer'),
        Row("— the peer's broken odometry given to our loops and graph: ATE before / after",
            '{:.2f} / {:.2f} m', ('u_turn.broken.odometry_ate_m', 'u_turn.broken.ate_m')),
        *(
            Row(f'{drive}, ours / KISS-SLAM: ATE', '{:.3f} / {:.3f} m',
                (f'peers.suite.{key}.ate_m', f'peers.kiss_slam.{key}.ate_m'))
            for key, drive in (('out_and_back', 'Out-and-back drive'), ('street_loop', 'A street'))
        ),
        Row('— loops right and wrong, out and back', '{:.0f} and {:.0f} / {:.0f} and {:.0f}',
            tuple(f'peers.{of}.out_and_back.loops_{kind}'
                  for of in ('suite', 'kiss_slam') for kind in ('right', 'wrong'))),
        Row('— time of a scan, out and back', '{:.0f} / {:.0f} ms',
            ('peers.suite.out_and_back.ms_per_scan', 'peers.kiss_slam.out_and_back.ms_per_scan')),
        Row('One graph update with loops and Path at 10,000 keyframes, 99 %', '{:.1f} ms',
            ('graph_update_p99_ms_at_10000',), '≤ 50 ms'),
        Row('An hour of replay: keyframes', '{:.0f}', ('memory.keyframes',)),
        Row('— growth of the processes for each keyframe, cloud and descriptor included',
            '{:.0f} kB', ('memory.bytes_per_keyframe',), '', 1e-3),
        Row('— without keyframes: size after 7 minutes / after 15', '{:.0f} / {:.0f} MB',
            ('memory.without_keyframes.resident_at_half_mb',
             'memory.without_keyframes.resident_at_end_mb'), 'no growth'),
    )),
    'lcdnet': Table('lcdnet', (
        Row('Average precision, protocol 1, same way / reverse: LCDNet', '{:.3f} / {:.3f}',
            ('ap.protocol1.same_way.lcdnet', 'ap.protocol1.reverse.lcdnet'), '≥ 0.97 / 0.95'),
        *(
            Row(f'— {name}', '{:.3f} / {:.3f}',
                (f'ap.protocol1.same_way.{key}', f'ap.protocol1.reverse.{key}'), 'below LCDNet')
            for key, name in (('lidar_iris', 'LiDAR-Iris'), ('scan_context', 'Scan Context'),
                              ('isc', 'Intensity Scan Context'), ('m2dp', 'M2DP'))
        ),
        Row('— MapClosures on 0.8 km of town 200 (LCDNet, Scan Context on the same)',
            '{:.3f} / {:.3f} ({:.3f} / {:.3f}, {:.3f} / {:.3f})',
            tuple(f'map_closures_drives.{kind}.{method}'
                  for method in ('map_closures', 'lcdnet', 'scan_context')
                  for kind in ('same_way', 'reverse')), 'below LCDNet'),
        Row('Protocol 2, same way / reverse: LCDNet', '{:.3f} / {:.3f}',
            ('ap.protocol2.same_way.lcdnet', 'ap.protocol2.reverse.lcdnet'), 'above all'),
        *(
            Row(f'— {name}', '{:.3f} / {:.3f}',
                (f'ap.protocol2.same_way.{key}', f'ap.protocol2.reverse.{key}'), 'below LCDNet')
            for key, name in (('lidar_iris', 'LiDAR-Iris'), ('scan_context', 'Scan Context'),
                              ('m2dp', 'M2DP'))
        ),
        *(
            Row(f'Protocol 1, town 200, {what}, same way / reverse: LCDNet (M2DP, Scan Context)',
                '{:.3f} / {:.3f} ({:.3f} / {:.3f}, {:.3f} / {:.3f})',
                tuple(f'{key}.protocol1.{kind}.{method}'
                      for method in ('lcdnet', 'm2dp', 'scan_context')
                      for kind in ('same_way', 'reverse')), asked)
            for key, what, asked in (
                ('ap_sector_45', 'sectors of 45° removed', ''),
                ('ap_sector_90', 'sectors of 90° removed', '≥ 0.70'),
                ('ap_rear_70', 'the rear 70° blocked', ''),
                ('ap_rear_70_aggregated', 'the same, scans aggregated', ''),
                ('ap_unseen_beams32', 'a sensor unseen in training', ''),
            )
        ),
        Row('Protocol 1, town 200, a second run among other cars: LCDNet (M2DP, Scan Context)',
            '{:.3f} ({:.3f}, {:.3f})',
            tuple(f'ap_other_traffic.protocol1.all.{method}'
                  for method in ('lcdnet', 'm2dp', 'scan_context')), '≥ 0.97, the best'),
        *(
            row
            for band, asked in (('0_4', '≥ 99.5 %'), ('4_10', ''), ('10_15', '≥ 90 %'))
            for row in (
                Row(f'Registered within 2 m and 5°, {band.replace("_", "-")} m apart: LCDNet',
                    '{:.1f} %', (f'registration.{band}.success.lcdnet',), asked, 100),
                Row('— KISS-Matcher / FPFH + RANSAC', '{:.1f} / {:.1f} %',
                    (f'registration.{band}.success.kiss_matcher',
                     f'registration.{band}.success.fpfh_ransac'), '', 100),
            )
        ),
        Row('Real pair KITTI 00 52 / 4501, worst of 20 yaws', '{:.2f} m, {:.2f}°',
            ('real.kitti_00.pair_translation_error_m', 'real.kitti_00.pair_rotation_error_deg'),
            '≤ 0.35 m, 0.6°'),
        Row('Real pairs of different places, rejected', '{:,.0f} of {:,.0f}',
            ('real.kitti_00.negatives_rejected', 'real.kitti_00.negatives'), 'all'),
        Row('Karlsruhe out and back, average precision: LCDNet / Scan Context / MapClosures',
            '{:.3f} / {:.3f} / {:.3f}',
            tuple(f'real.out_and_back.ap_protocol1.{method}'
                  for method in ('lcdnet', 'scan_context', 'map_closures')), 'LCDNet the best'),
        Row('Loops that the nodes close there, right / wrong: LCDNet (Scan Context)',
            '{:.0f} / {:.0f} ({:.0f} / {:.0f})',
            tuple(f'loops_of_the_nodes.out_and_back.{method}.{kind}'
                  for method in ('lcdnet', 'scan_context') for kind in ('true', 'false')),
            'as many, none wrong'),
        Row('Descriptor and features of a sweep, two cores', '{:.0f} ms',
            ('descriptor_ms.compact_cpu',), '≤ 150 ms'),
        Row('— the full-size network', '{:.0f} ms', ('descriptor_ms.full_cpu',), '≤ 600 ms'),
        Row('Registration from stored keypoints', '{:.0f} ms', ('registration_ms',), '≤ 100 ms'),
        Row('Query among 18,235 / 1,000,000', '{:.2f} / {:.1f} ms',
            ('query_ms.18235', 'query_ms.1000000'), '≤ 1 / 20 ms'),
        Row('Memory of a keyframe', '{:.0f} kB', ('keyframe_bytes',), '≤ 500 kB', 1e-3),
    )),
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    parser = argparse.ArgumentParser(
        prog='python -m benchmarks.tables',
        description=__doc__,
        epilog='examples:\n  python -m benchmarks.tables          rewrite the tables\n'
        '  python -m benchmarks.tables --check  say whether they are up to date',
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        '--check', action='store_true', help='change nothing; fail when out of date'
    )
    parser.add_argument('--readme', type=Path, nargs='+', default=READMES, metavar='FILE')
    parser.add_argument('--results', type=Path, default=ROOT / 'benchmarks' / 'results')
    arguments = parser.parse_args(argv)
    return run(lambda: _update(arguments.readme, arguments.results, arguments.check))


def rewritten(text: str, results: Path) -> str:
    """Return a text with every marked table made anew.

    Raises:
        DataError: a table is unknown, its result file is missing or broken, or there is no table.
    """

    def block(match: re.Match[str]) -> str:
        name = match.group(2)
        if name not in TABLES:
            raise DataError(f'table {name!r} is unknown; it must be one of {", ".join(TABLES)}')
        figures = _read(results / f'{TABLES[name].results}.json')
        return match.group(1) + TABLES[name].markdown(figures) + match.group(4)

    new, count = _BLOCK.subn(block, text)
    if not count:
        raise DataError('expected a block <!-- table:NAME --> ... <!-- end -->, found none')
    return new


def _update(readmes: Sequence[Path], results: Path, check: bool) -> int:
    """Rewrite the files, or only say which differ; return 1 when one was to be checked and does."""
    different = 0
    for readme in readmes:
        shown = readme.relative_to(ROOT) if readme.is_relative_to(ROOT) else readme
        old = readme.read_text()
        new = rewritten(old, results)
        if new == old:
            sys.stdout.write(f'{shown}: the tables are up to date\n')
        elif check:
            different = 1
            sys.stdout.write(f'{shown}: the tables differ; run python -m benchmarks.tables\n')
        else:
            readme.write_text(new)
            sys.stdout.write(f'{shown}: tables rewritten\n')
    return different


def _read(path: Path) -> Mapping[str, Any]:
    try:
        figures = json.loads(path.read_text())
    except json.JSONDecodeError as error:
        raise DataError(f'{path}: expected JSON: {error}; measure again') from None
    if not isinstance(figures, dict):
        raise DataError(
            f'{path}: expected nested keys, got {type(figures).__name__}; measure again'
        )
    return figures


if __name__ == '__main__':
    sys.exit(main())
