"""Make samples for training: the command `make_cmrnet_samples`."""

import argparse
import logging
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from bags.input_arguments import add_input, add_span, drive_from
from bags.inputs import span_ns
from cmrnet_ekf.mapping.local_map import LocalMap, LocalMapConfig
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.pose_sampling import STAGES
from cmrnet_ekf.training.sample_maker import SamplesConfig, make_samples
from cmrnet_ekf.training.variants import NETWORKS
from lcd_common.command_line import run
from lcd_common.errors import ConfigError, DataError
from lcd_common.setting_changes import changed
from lcd_common.trajectory import read_tum

_log = logging.getLogger(__name__)
_EXAMPLES = """
examples:
  make_cmrnet_samples towns:0-9 --out samples        ten simulated towns: samples/town_0_run1 ...
  make_cmrnet_samples towns:100-101 --out judged --length 600
  make_cmrnet_samples towns:0-9 --out samples2 --stage 2        for the second network
  make_cmrnet_samples towns:0-9 --out samples --turn 2          bends are seen more often
  make_cmrnet_samples KITTI --sequence 03 --map maps/03 --out samples/kitti_03
                                                     a drive with camera and truth, and its map
  make_cmrnet_samples drive.mcap --poses trajectory.tum --map map --out samples/drive

Towns are mapped on one run and seen on another: other cars, light and lanes. Their maps are kept
in --maps and used again. towns 0-99 are for training, 100-109 for validation, 200-209 for tests.
Samples hold images as one network takes them (--network), and guesses of one stage.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _make(arguments))


def _make(arguments: argparse.Namespace) -> None:
    kind, _, numbers = arguments.input.partition(':')
    if kind == 'towns':
        for town in _numbers(numbers):
            _town(town, arguments)
        return
    if arguments.map is None:
        raise ConfigError(f'{arguments.input}: a drive needs --map; build_lidar_map makes it')
    drive = drive_from(arguments)
    poses = read_tum(arguments.poses) if arguments.poses else drive.truth()
    if poses is None:
        raise DataError(f'{arguments.input}: has no ground truth; give --poses FILE.tum')
    span = span_ns(drive, arguments.start, arguments.duration)
    _samples(arguments.out, drive, poses, arguments.map, arguments, span)


def _town(number: int, arguments: argparse.Namespace) -> None:
    from cmrnet_ekf.training.towns import map_town, seen_town

    seen = seen_town(number, arguments.length)
    out = arguments.out / seen.name
    if (out / 'facts.json').is_file():
        _log.info('%s: there already', out)
        return
    path = (arguments.maps or arguments.out / 'maps') / f'town_{number}'
    settings = MapConfig(voxel=arguments.voxel)
    map_town(path, number, arguments.length, settings, arguments.every, arguments.quiet)
    _samples(out, seen, seen.truth(), path, arguments, (None, None))


def _samples(
    out: Path, drive: Any, poses: Any, map_path: Path, arguments: argparse.Namespace, span: Any
) -> None:
    network = changed(NETWORKS[arguments.network][0], arguments.set).check()
    settings = SamplesConfig(arguments.spacing, arguments.turn, arguments.draws)
    local_map = LocalMap(map_path, replace(LocalMapConfig(), kept_tiles=2000))
    with tqdm(unit='frame', desc=out.name, disable=arguments.quiet) as bar:
        count = make_samples(
            out, drive, poses, local_map, network, STAGES[arguments.stage - 1], settings,
            progress=lambda: _advance(bar), span_ns=span,
        )  # fmt: skip
    sys.stdout.write(f'{out}: {count} samples\n')


def _advance(bar: Any) -> None:
    bar.update()


def _numbers(text: str) -> list[int]:
    """Read 3, 0-9 or 1,4,7-8."""
    numbers: list[int] = []
    for part in text.split(','):
        first, _, last = part.partition('-')
        if not first.isdecimal() or (last and not last.isdecimal()):
            raise ConfigError(
                f'towns: expects numbers such as towns:0-9 or towns:3,5, got {text!r}'
            )
        numbers.extend(range(int(first), int(last or first) + 1))
    return numbers


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='make_cmrnet_samples',
        description='Make samples for CMRNet: images, and the map as seen from wrong guesses.',
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_input(parser)
    add_span(parser)
    add, defaults = parser.add_argument, SamplesConfig()
    add('--out', type=Path, required=True, help='folder of the samples, or of those of all towns')
    add('--length', type=float, default=600.0, metavar='M', help='of a town (default: 600)')
    add('--maps', type=Path, help='folder of the maps of towns (default: maps in --out)')
    add('--voxel', type=float, default=MapConfig().voxel, metavar='M',
        help='of the maps of towns (default: %(default)s)')  # fmt: skip
    add('--every', type=int, default=2, metavar='N', help='map each N-th sweep (default: 2)')
    add('--map', type=Path, help='map of INPUT')
    add('--poses', type=Path, metavar='TUM', help='poses of base_link (default: ground truth)')
    add('--stage', type=int, choices=(1, 2, 3), default=1, help='range of guesses (default: 1)')
    add('--network', choices=sorted(NETWORKS), default='compact', help='(default: compact)')
    add('--set', nargs='+', default=[], metavar='NAME=VALUE', help='settings of the network')
    add('--spacing', type=float, default=defaults.spacing, metavar='M', help='(default: 1)')
    add('--turn', type=float, default=defaults.turn, metavar='DEG', help='frames after turns, too')
    add('--draws', type=int, default=defaults.draws, help='guesses of a frame (default: 8)')
    add('--quiet', action='store_true', help='no progress bars')
    return parser


if __name__ == '__main__':
    sys.exit(main())
