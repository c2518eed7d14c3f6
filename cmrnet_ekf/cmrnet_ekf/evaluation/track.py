"""Track a drive by networks and a filter: the command `track_cmrnet`."""

import argparse
import json
import logging
import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from tqdm import tqdm

from bags.input_arguments import add_input, add_span, drive_from
from bags.inputs import span_ns
from bags.records import Drive
from cmrnet_ekf.evaluation.evaluate import RESULTS, results_folder
from cmrnet_ekf.evaluation.named_networks import named_predictors
from cmrnet_ekf.evaluation.tracking import THESIS, VEHICLE, Track, TrackingConfig
from cmrnet_ekf.evaluation.tracking_drive import TrackingDrive, record
from cmrnet_ekf.evaluation.tracking_filters import VehicleTrackingConfig
from cmrnet_ekf.evaluation.tracking_study import draw, figures_of, markdown, tracks, ways
from cmrnet_ekf.mapping.local_map import LocalMap, LocalMapConfig
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.networks.config import CmrnetConfig
from cmrnet_ekf.predictors import Predictor
from lcd_common.command_line import run
from lcd_common.device import choose_device
from lcd_common.errors import ConfigError, DataError
from lcd_common.setting_changes import changed
from lcd_common.trajectory import read_tum

_log = logging.getLogger(__name__)
_EXAMPLES = """
examples:
  track_cmrnet drive.mcap --map map --networks mcd=runs/mcd der=runs/der --out tracked
  track_cmrnet towns:200 --length 1200 --map maps/town_200 --networks cmrnet=runs/plain0 \\
      de=runs/plain0,runs/plain1,runs/plain2 der=runs/der --runs 20 --out tracked
  track_cmrnet drive.mcap --map map --networks der=runs/der fine=runs/der \\
      --second fine=runs/fine_der --out tracked          one stage beside two, each from the last
  track_cmrnet KITTI --sequence 00 --map maps/00 --networks der=runs/der --out tracked \\
      --set start_translation=1 speed_scale=0.02
  track_cmrnet towns:200 --map maps/town_200 --networks der=runs/der --filter thesis --out thesis

towns:N is a simulated town, mapped (into --map, if that is not there yet) on one run and driven on
another. Each run starts at a wrong pose and has no satellites. The camera is asked from what the
filter predicts; wheels err (--set). --filter vehicle: the EKF of this package, moved by inertial
samples (--ekf sets what it is told of camera and wheels); thesis: Algorithm 2, moved by the
gyroscope's turns and the wheels, which adds 0.5 m^2 to the variance at every image.
Rows: the thesis's motion model alone; the vehicle's EKF without a camera (inertial); the motion
model corrected by a plain network without a filter; the filter with each network that says how
sure it is. Of several stages, those begin that are for guesses as sure as the filter's; the last
one counts. Written are results.json,
results.md, heat.png and tracks.npz; the images, as the networks take them, are kept in --frames and
used again.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _track(arguments))


def _track(arguments: argparse.Namespace) -> None:
    out = results_folder(arguments.out)
    device = choose_device(arguments.device)
    networks = _staged([arguments.networks, arguments.second, arguments.third], device)
    settings = changed(TrackingConfig(), arguments.set)
    told = changed(VehicleTrackingConfig(), arguments.ekf)
    first = next(iter(networks.values()))[0].settings
    drive = _recorded(arguments, first)
    local_map = LocalMap(arguments.map, LocalMapConfig(kept_tiles=2000))
    chosen = ways(networks, arguments.filter)
    runs = dict.fromkeys(chosen, arguments.runs)
    found: dict[str, list[Track]] = defaultdict(list)
    total = sum(runs.values()) * (len(drive) - 1)
    with tqdm(total=total, unit='image', disable=arguments.quiet) as bar:
        for name, one in tracks(drive, local_map, chosen, runs, settings, told, bar.update):
            found[name].append(one)
    figures = {name: figures_of(of_way) for name, of_way in found.items()}
    blind = [n for n, way in chosen.items() if way.stages and figures[n]['skipped_share'] == 1.0]
    if blind:
        _log.warning(
            '%s never saw the map: are the poses of the drive in its frame? --poses gives others',
            ', '.join(blind),
        )
    out.mkdir(parents=True, exist_ok=True)
    facts = {'drive': drive.name, 'filter': arguments.filter, 'ways': figures}
    (out / RESULTS).write_text(json.dumps(facts, indent=1) + '\n')
    about = (
        f'{drive.name}: {len(drive)} images over {drive.length_m:.0f} m; filter: '
        f'{arguments.filter}; turns by {drive.turned_by}'
    )
    text = markdown(figures, about)
    draw(drive, found, out / 'heat.png')
    (out / 'results.md').write_text(f'# Tracking\n\n{text}\n![heat map](heat.png)\n')
    write_tracks(found, out / 'tracks.npz')
    sys.stdout.write(text)
    sys.stdout.write(f'written to {out}: {RESULTS}, results.md, heat.png, tracks.npz\n')


def write_tracks(found: dict[str, list[Track]], path: Path) -> None:
    """Write WAY_SEED_pose [F x 4 x 4] with its NEES, and the errors of camera observations."""
    arrays = {}
    for name, of_way in found.items():
        for one in of_way:
            arrays[f'{name}_{one.seed}_pose'] = one.T_map_base
            arrays[f'{name}_{one.seed}_nees'] = one.nees
            arrays[f'{name}_{one.seed}_xi'] = one.xi
            arrays[f'{name}_{one.seed}_covariance'] = one.covariances
    np.savez_compressed(path, allow_pickle=False, **arrays)


def _staged(
    texts: Sequence[Sequence[str]], device: torch.device | str
) -> dict[str, list[Predictor]]:
    """Return the stages of each network by name; `texts` are those of each stage."""
    found = {name: [one] for name, one in named_predictors(texts[0], device).items()}
    images = tuple(next(iter(found.values()))[0].settings.images)
    for number, stage in enumerate(texts[1:], start=2):
        for name, predictor in named_predictors(stage, device).items():
            if len(found.get(name, ())) != number - 1:
                raise ConfigError(f'stage {number} has {name}, the stage before has not')
            found[name].append(predictor)
    for name, stages in found.items():
        for number, predictor in enumerate(stages, start=1):
            if tuple(predictor.settings.images) != images:
                raise ConfigError(
                    f'{name}, stage {number}, takes images {tuple(predictor.settings.images)}, '
                    f'the first network {images}: all must take the same'
                )
    return found


def _recorded(arguments: argparse.Namespace, network: CmrnetConfig) -> TrackingDrive:
    folder = arguments.frames or arguments.out.with_name(arguments.out.name + '_frames')
    drive = _drive(arguments)
    poses = read_tum(arguments.poses) if arguments.poses else drive.truth()
    if poses is None:
        raise DataError(f'{arguments.input}: has no ground truth; give --poses FILE.tum')
    span = span_ns(drive, arguments.start, arguments.duration)
    with tqdm(unit='image', desc='frames', disable=arguments.quiet) as bar:
        recorded = record(folder, drive, poses, network, span, bar.update)
    if recorded.name != drive.name or recorded.images != tuple(network.images):
        raise DataError(f'{folder}: frames of another drive or network; name another folder')
    at = poses.at(int(recorded.stamps_ns[0]))
    if at is None or not np.allclose(at, recorded.T_map_base[0], atol=1e-6):
        raise DataError(f'{folder}: frames recorded with other poses; name another folder')
    return recorded


def _drive(arguments: argparse.Namespace) -> Drive:
    kind, _, number = arguments.input.partition(':')
    if kind != 'towns':
        return drive_from(arguments)
    if not number.isdecimal():
        raise ConfigError(f'expected towns:N, got {arguments.input}')
    from cmrnet_ekf.training.towns import map_town, seen_town

    town = int(number)
    map_town(arguments.map, town, arguments.length, MapConfig(), 2, arguments.quiet)
    return seen_town(town, arguments.length, imu='rt3003')


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='track_cmrnet',
        description="Track a drive in closed loop: CMRNet's networks and an EKF.",
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_input(parser)
    add_span(parser)
    add = parser.add_argument
    add('--map', type=Path, required=True, help='LiDAR map of where it goes (build_lidar_map)')
    add('--networks', nargs='+', required=True, metavar='NAME=PATH[,PATH]',
        help='weights, or folders of train_cmrnet; several are an ensemble')  # fmt: skip
    add('--second', nargs='+', default=[], metavar='NAME=PATH[,PATH]',
        help='networks of the second stage, by the same names')  # fmt: skip
    add('--third', nargs='+', default=[], metavar='NAME=PATH[,PATH]', help='of the third')
    add('--out', type=Path, required=True, help='folder for the results')
    add('--frames', type=Path, help='folder that keeps the images (default: OUT_frames)')
    add('--poses', type=Path, metavar='TUM', help='poses of base_link (default: ground truth)')
    add('--length', type=float, default=1200.0, metavar='M', help='of a town (default: 1200)')
    add('--runs', type=_count, default=3, help='of each way, seeds 0, 1, ... (default: 3)')
    add('--filter', choices=(VEHICLE, THESIS), default=VEHICLE, help='(default: vehicle)')
    add('--set', nargs='+', default=[], metavar='NAME=VALUE', help='settings of starts and wheels')
    add('--ekf', nargs='+', default=[], metavar='NAME=VALUE',
        help="what the vehicle's EKF is told of camera and wheels")  # fmt: skip
    add('--device', default='auto', help='auto, cpu, cuda, cuda:1 ... (default: auto)')
    add('--quiet', action='store_true', help='no progress bars')
    return parser


def _count(text: str) -> int:
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f'{text} is no number of at least 1')
    return int(text)


if __name__ == '__main__':
    sys.exit(main())
