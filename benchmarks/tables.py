"""Write the README's result tables from benchmarks/results/*.json: no number is copied by hand.

A table stands in README.md between `<!-- table:NAME -->` and `<!-- end -->`; NAME.json has its
figures.
"""

import argparse
import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from lcd_common.command_line import run
from lcd_common.errors import DataError

ROOT = Path(__file__).resolve().parents[1]
_BLOCK = re.compile(r'(<!-- table:([\w-]+) -->\n)(.*?)(<!-- end -->)', re.DOTALL)


@dataclass(frozen=True)
class Row:
    """One row: what was measured, how it is written, and what was asked for.

    Attributes:
        what: for people.
        shown: a format string for the values, e.g. '{:.0f} / {:.0f} ms'.
        keys: dotted keys of the values in the result file.
        asked: the limit, or empty.
        times: factor of the values, e.g. 100 for a share shown in percent.
    """

    what: str
    shown: str
    keys: tuple[str, ...]
    asked: str = ''
    times: float = 1.0


TABLES: dict[str, tuple[Row, ...]] = {
    'drive': (
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
        Row('One graph update at 10,000 keyframes, 99 %', '{:.1f} ms',
            ('graph_update_p99_ms_at_10000',), '≤ 50 ms'),
        Row('Memory of a keyframe', '{:.1f} kB', ('memory.bytes_per_keyframe',), '', 1e-3),
    ),
    'town': (
        Row('HDL-64E sweeps a second, two cores', '{:.1f}', ('sweeps_per_second_cpu',), '≥ 12'),
        Row('— on a GPU, by the torch renderer', '{:.0f}', ('sweeps_per_second_gpu',), '≥ 300'),
        Row('Camera frames of 1241 x 376 a second, two cores', '{:.1f}',
            ('camera_frames_per_second_cpu',), '≥ 8'),
        Row('Rays on which both renderers agree within 1 cm', '{:.3f} %',
            ('renderers_within_1cm_share',), '≥ 99.9 %', 100),
        Row('Drift of KISS-ICP', '{:.2f} %', ('kiss_icp_drift_percent',), '0.3-0.8 %'),
        Row('Average precision of Scan Context, same way', '{:.2f}',
            ('scan_context_ap.same_way',), '0.90-0.98'),
        Row('— in reverse', '{:.2f}', ('scan_context_ap.reverse',), '0.50-0.80'),
        Row('Live at 10 Hz: scans that odometry lost', '{:.0f}', ('live_10hz.odometry_lost',), '0'),
        Row('— odometry latency, 99 %', '{:.0f} ms',
            ('live_10hz.odometry_latency_p99_ms',), '≤ 150 ms'),
    ),
    'lcdnet': (
        Row('Average precision, protocol 1, same way / reverse: LCDNet', '{:.3f} / {:.3f}',
            ('ap.protocol1.same_way.lcdnet', 'ap.protocol1.reverse.lcdnet'), '≥ 0.97 / 0.95'),
        *(
            Row(f'— {name}', '{:.3f} / {:.3f}',
                (f'ap.protocol1.same_way.{key}', f'ap.protocol1.reverse.{key}'), 'below LCDNet')
            for key, name in (('lidar_iris', 'LiDAR-Iris'), ('scan_context', 'Scan Context'),
                              ('isc', 'Intensity Scan Context'), ('m2dp', 'M2DP'),
                              ('map_closures', 'MapClosures'))
        ),
        Row('Protocol 2, same way / reverse: LCDNet', '{:.3f} / {:.3f}',
            ('ap.protocol2.same_way.lcdnet', 'ap.protocol2.reverse.lcdnet'), 'above all'),
        *(
            Row(f'— {name}', '{:.3f} / {:.3f}',
                (f'ap.protocol2.same_way.{key}', f'ap.protocol2.reverse.{key}'), 'below LCDNet')
            for key, name in (('lidar_iris', 'LiDAR-Iris'), ('scan_context', 'Scan Context'))
        ),
        *(
            Row(f'Registered within 2 m and 5°, {band.replace("_", "-")} m apart: '
                'LCDNet / KISS-Matcher / FPFH + RANSAC', '{:.1f} / {:.1f} / {:.1f} %',
                tuple(f'registration.{band}.success.{method}'
                      for method in ('lcdnet', 'kiss_matcher', 'fpfh_ransac')), asked, 100)
            for band, asked in (('0_4', '≥ 99.5 %'), ('4_10', ''), ('10_15', '≥ 90 %'))
        ),
        Row('Real pair KITTI 00 52 / 4501, worst of 20 yaws', '{:.2f} m, {:.2f}°',
            ('real.kitti_00.pair_translation_error_m', 'real.kitti_00.pair_rotation_error_deg'),
            '≤ 0.35 m, 0.6°'),
        Row('Descriptor and features of a sweep, two cores', '{:.0f} ms',
            ('descriptor_ms.compact_cpu',), '≤ 150 ms'),
        Row('— the full-size network', '{:.0f} ms', ('descriptor_ms.full_cpu',), '≤ 600 ms'),
        Row('Registration from stored keypoints', '{:.0f} ms', ('registration_ms',), '≤ 100 ms'),
        Row('Query among 18,235 / 1,000,000', '{:.2f} / {:.1f} ms',
            ('query_ms.18235', 'query_ms.1000000'), '≤ 1 / 20 ms'),
        Row('Memory of a keyframe', '{:.0f} kB', ('keyframe_bytes',), '≤ 500 kB', 1e-3),
    ),
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
    parser.add_argument('--readme', type=Path, default=ROOT / 'README.md')
    parser.add_argument('--results', type=Path, default=ROOT / 'benchmarks' / 'results')
    arguments = parser.parse_args(argv)
    return run(lambda: _update(arguments.readme, arguments.results, arguments.check))


def table(rows: Sequence[Row], figures: Mapping[str, Any]) -> str:
    """Return a markdown table; what the figures lack is written as not measured."""
    lines = ['| what | measured | asked |', '|---|---|---|']
    lines += [f'| {row.what} | {_shown(row, figures)} | {row.asked} |' for row in rows]
    origin = _origin(figures)
    return '\n'.join(lines) + '\n' + (f'\n{origin}\n' if origin else '')


def rewritten(text: str, results: Path) -> str:
    """Return a text with every marked table made anew.

    Raises:
        DataError: a table is unknown, its result file is missing or broken, or there is no table.
    """

    def block(match: re.Match[str]) -> str:
        name = match.group(2)
        if name not in TABLES:
            raise DataError(f'table {name!r} is unknown; it must be one of {", ".join(TABLES)}')
        return (
            match.group(1) + table(TABLES[name], _read(results / f'{name}.json')) + match.group(4)
        )

    new, count = _BLOCK.subn(block, text)
    if not count:
        raise DataError('expected a block <!-- table:NAME --> ... <!-- end -->, found none')
    return new


def _update(readme: Path, results: Path, check: bool) -> int:
    old = readme.read_text()
    new = rewritten(old, results)
    if new == old:
        sys.stdout.write(f'{readme.name}: the tables are up to date\n')
        return 0
    if check:
        sys.stdout.write(f'{readme.name}: the tables differ; run python -m benchmarks.tables\n')
        return 1
    readme.write_text(new)
    sys.stdout.write(f'{readme.name}: tables rewritten\n')
    return 0


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


def _value(figures: Mapping[str, Any], key: str) -> float | None:
    value: Any = figures
    for part in key.split('.'):
        value = value.get(part) if isinstance(value, Mapping) else None
    return float(value) if isinstance(value, int | float) and value == value else None


def _shown(row: Row, figures: Mapping[str, Any]) -> str:
    values = [_value(figures, key) for key in row.keys]
    known = [value * row.times for value in values if value is not None]
    return row.shown.format(*known) if len(known) == len(values) else 'not measured'


def _origin(figures: Mapping[str, Any]) -> str:
    """Say at which commit, when and on what the figures were measured."""
    for group in (figures, *figures.values()):
        if isinstance(group, Mapping) and {'commit', 'date', 'machine'} <= set(group):
            return f'Measured at commit `{group["commit"]}` on {group["date"]}: {group["machine"]}.'
    return ''


if __name__ == '__main__':
    sys.exit(main())
