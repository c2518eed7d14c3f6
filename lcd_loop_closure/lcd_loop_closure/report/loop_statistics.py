"""Print how often trajectories return to places they have seen: the thesis's Table 3.1."""

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np

from lcd_common import se3
from lcd_common.command_line import run
from lcd_common.errors import DataError
from lcd_loop_closure.report.reference import read_reference
from lcd_loop_closure.revisits import RevisitConfig, RevisitStatistics, count_revisits

_DEFAULTS = RevisitConfig()
_EXAMPLES = """
examples:
  loop_statistics poses_lidar_08.txt
  loop_statistics poses/00.txt poses/05.txt poses/08.txt
  loop_statistics poses/08.txt --calib sequences/08/calib.txt   camera poses, counted for the LiDAR
  loop_statistics results/demo/corrected.tum --json
  loop_statistics drive.tum --distance 10 --excluded 100

A scan i (from scan --first on) and a scan j at least --excluded scans before it are a pair when
they lie within --distance of each other; a scan with at least one pair is a loop. A pair is
reverse when the vehicle was turned by more than --reverse degrees between the two.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _print_statistics(arguments))


def read_lidar_mounting(path: Path) -> se3.Array:
    """Return T_camera_lidar, the row `Tr:` (or `Tr_velo_to_cam:`) of a KITTI calib.txt.

    Raises:
        DataError: there is no such row of 12 numbers.
    """
    for line in path.read_text().splitlines():
        name, _, values = line.partition(':')
        if name.strip() in ('Tr', 'Tr_velo_to_cam', 'Tr_velo_cam'):
            try:
                T = np.vstack([np.array(values.split(), float).reshape(3, 4), [0, 0, 0, 1]])
            except ValueError:
                break
            return T
    raise DataError(f'{path}: expected a row "Tr:" with 12 numbers; give the sequence\'s calib.txt')


def _print_statistics(arguments: argparse.Namespace) -> None:
    settings = RevisitConfig(
        distance=arguments.distance,
        excluded_scans=arguments.excluded,
        first_scan=arguments.first,
        reverse_angle=float(np.radians(arguments.reverse)),
    )
    T_camera_lidar = None if arguments.calib is None else read_lidar_mounting(arguments.calib)
    counted: list[tuple[Path, RevisitStatistics]] = []
    for path in arguments.poses:
        poses = read_reference(path).T_world_body
        if T_camera_lidar is not None:
            poses = se3.inverse(T_camera_lidar) @ poses @ T_camera_lidar
        counted.append((path, count_revisits(poses, settings)))
    if arguments.json:
        rows = [{'file': str(path), **asdict(statistics)} for path, statistics in counted]
        sys.stdout.write(json.dumps({'settings': asdict(settings), 'files': rows}, indent=2) + '\n')
        return
    width = max(len(str(path)) for path, _ in counted)
    header = f'{"poses":<{width}}  {"scans":>7}  {"loops":>7}  {"pairs":>9}  reverse   length'
    sys.stdout.write(header + '\n')
    for path, s in counted:
        share = '-' if s.reverse_share is None else f'{100 * s.reverse_share:.1f} %'
        sys.stdout.write(
            f'{path!s:<{width}}  {s.scans:>7}  {s.loops:>7}  {s.pairs:>9}  {share:>7}  '
            f'{s.length_m:>6.0f} m\n'
        )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='loop_statistics',
        description=__doc__,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        'poses', type=Path, nargs='+', metavar='POSES', help='KITTI or TUM poses file'
    )
    parser.add_argument(
        '--calib', type=Path, help="KITTI calib.txt: poses are the camera's, count the LiDAR's"
    )
    parser.add_argument(
        '--distance',
        type=float,
        default=_DEFAULTS.distance,
        metavar='M',
        help='largest distance of a pair, metres (default: %(default)g)',
    )
    parser.add_argument(
        '--excluded',
        type=int,
        default=_DEFAULTS.excluded_scans,
        metavar='N',
        help='scans just before one that do not count (default: %(default)d)',
    )
    parser.add_argument(
        '--first',
        type=int,
        default=_DEFAULTS.first_scan,
        metavar='N',
        help='first scan that is asked (default: %(default)d)',
    )
    parser.add_argument(
        '--reverse',
        type=float,
        default=round(float(np.degrees(_DEFAULTS.reverse_angle))),
        metavar='DEG',
        help='a pair turned by more is reverse (default: %(default)g)',
    )
    parser.add_argument('--json', action='store_true', help='print JSON')
    return parser


if __name__ == '__main__':
    sys.exit(main())
