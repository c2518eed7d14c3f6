"""Build a LiDAR map from a drive: the command `build_lidar_map`."""

import argparse
import logging
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from bags.input_arguments import add_input, add_span, drive_from
from bags.inputs import span_ns
from bags.numbered_files import read_labels
from bags.records import Drive, LidarScan
from cmrnet_ekf.mapping.map_builder import MapBuilder
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.mapping.tile_folder import TileFolder
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.command_line import run
from lcd_common.errors import ConfigError, DataError
from lcd_common.trajectory import Trajectory, read_tum

_log = logging.getLogger(__name__)
_EXAMPLES = """
examples:
  build_lidar_map drive.mcap --out map               with the ground truth of the recording
  build_lidar_map drive.mcap --poses trajectory.tum --out map
                                                     with poses of run_drive or of any SLAM
  build_lidar_map saved_map --sensor-height 1.73 --out map
                                                     keyframes of a map that pose_graph saved
  build_lidar_map DATASET --sequence 00 --labels DATASET/sequences/00/labels --out map
                                                     SemanticKITTI's labels say what moves
  build_lidar_map town:3 --labels --out map          a simulated town, which knows what moves
  build_lidar_map town3.mcap --labels --out map      a bag whose points have a field 'label'
  build_lidar_map town:3:1 --out map                 the same again goes on with the map

The map is a folder of tiles. It may be larger than memory; a map that is there already grows.
Without labels, what other sweeps saw through is taken for moving. A saved map keeps clouds in
base_link's frame: how high the LiDAR sat, from where it saw, must be told (or --keep-moving).
"""
_HIGHEST_M = 20.0
_OF_DRIVES = ('poses', 'labels', 'start', 'duration', 'format', 'sequence', 'topic')


@dataclass(frozen=True)
class Sweep:
    """A sweep with its place; `moving` [N] where labels say it."""

    cloud: PointCloud
    T_map_base: se3.Array
    T_base_sensor: se3.Array
    moving: NDArray[np.bool_] | None = None


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _build(arguments))


def _build(arguments: argparse.Namespace) -> None:
    if arguments.every < 1:
        raise ConfigError('--every must be at least 1')
    settings = replace(
        MapConfig(),
        voxel=arguments.voxel,
        max_range=arguments.max_range,
        see_through=not arguments.keep_moving,
    )
    saved = Path(arguments.input)
    sweeps: Iterator[Sweep]
    total: int | None
    if (saved / 'graph.npz').is_file():
        sweeps, total = _keyframes(saved, arguments)
    elif arguments.sensor_height is not None:
        raise ConfigError(
            f'--sensor-height is of a saved map; {arguments.input} says itself where its LiDAR sits'
        )
    else:
        sweeps, total = _of_drive(drive_from(arguments), arguments)
    builder = MapBuilder(TileFolder.create(arguments.out, settings), settings)
    for sweep in tqdm(sweeps, total=total, unit='sweep', disable=arguments.quiet):
        builder.add(sweep.cloud, sweep.T_map_base, sweep.T_base_sensor, sweep.moving)
    if not builder.sweeps:
        raise DataError(f'{arguments.input}: no sweep has a pose; give --poses of the same time')
    staying = builder.finish()
    sys.stdout.write(
        f'{arguments.out}: {builder.sweeps} sweeps, {staying} points in '
        f'{len(builder.folder.tiles())} tiles\n'
    )


def _of_drive(drive: Drive, arguments: argparse.Namespace) -> tuple[Iterator[Sweep], int | None]:
    poses = read_tum(arguments.poses) if arguments.poses else drive.truth()
    if poses is None:
        raise DataError(
            f'{arguments.input}: has no ground truth; give --poses FILE.tum, e.g. of run_drive'
        )
    counts = [s.count for s in drive.streams() if 'PointCloud2' in s.type_name]
    start, end = span_ns(drive, arguments.start, arguments.duration)
    sweeps = drive_sweeps(drive, poses, start, end, arguments.every, arguments.labels)
    return sweeps, sum(counts) // arguments.every if arguments.duration is None else None


def drive_sweeps(
    drive: Drive,
    poses: Trajectory,
    start_ns: int | None = None,
    end_ns: int | None = None,
    every: int = 1,
    labels: str | None = None,
) -> Iterator[Sweep]:
    """Yield the sweeps of a drive that have a pose.

    Args:
        drive: of any format.
        poses: of base_link.
        start_ns, end_ns: the part to read, inclusive.
        every: take each so many-th sweep.
        labels: None; '' for those in the drive itself (simulated, SemanticKITTI, bags with a field
            'label'); else a folder of SemanticKITTI's .label files, one for each sweep.

    Raises:
        DataError: a sensor has no place, or labels do not fit.
    """
    places = {m.child: m.T_parent_child for m in drive.mountings}
    for number, scan in enumerate(drive.records(start_ns, end_ns, [LidarScan])):
        assert isinstance(scan, LidarScan)
        if number % every:
            continue
        T_map_base = poses.at(scan.stamp_ns)
        if T_map_base is None:
            continue
        if scan.frame_id not in places:
            raise DataError(
                f'{drive.path}: nothing says where {scan.frame_id} sits; it has '
                f'{", ".join(places) or "no mountings"}'
            )
        cloud = scan.cloud
        if labels:
            label = read_labels(Path(labels) / f'{number:06d}.label', len(cloud))
            cloud = replace(cloud, label=label)
        moving = None if labels is None else cloud.moving
        if labels is not None and moving is None:
            raise DataError(f'{drive.path}: its points have no labels; leave --labels out')
        yield Sweep(cloud, T_map_base, places[scan.frame_id], moving)


def _keyframes(path: Path, arguments: argparse.Namespace) -> tuple[Iterator[Sweep], int]:
    from lcd_loop_closure.map_store import load_map

    plain = _parser()
    strange = [f'--{n}' for n in _OF_DRIVES if getattr(arguments, n) != plain.get_default(n)]
    if strange:
        raise ConfigError(
            f'{path}: is a saved map, which has poses and clouds of its own; leave out '
            f'{", ".join(strange)}, or map the drive itself'
        )
    height_m = arguments.sensor_height
    if height_m is None:
        if not arguments.keep_moving:
            raise ConfigError(
                f'{path}: a saved map does not say where the LiDAR sat; give --sensor-height M, '
                'its height over base_link (KITTI: 1.73), or --keep-moving'
            )
        height_m = 0.0  # nobody asks what a sweep saw through
    if not 0.0 <= height_m <= _HIGHEST_M:
        raise ConfigError(
            f'--sensor-height must be 0 to {_HIGHEST_M:g} metres over base_link, got {height_m:g}'
        )
    saved = load_map(path)
    T_base_sensor = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, height_m])
    rows = range(0, len(saved.graph), arguments.every)

    def sweeps() -> Iterator[Sweep]:
        for row in rows:
            cloud = saved.keyframe(row).cloud.transformed(se3.inverse(T_base_sensor))
            yield Sweep(cloud, saved.graph.T_map_base[row], T_base_sensor)

    return sweeps(), len(rows)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='build_lidar_map',
        description='Build a tiled LiDAR map from sweeps and poses.',
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_input(parser)
    add_span(parser)
    add, defaults = parser.add_argument, MapConfig()
    add('--out', type=Path, required=True, help='folder of the map; one that is there grows')
    add('--poses', type=Path, metavar='TUM', help='poses of base_link (default: ground truth)')
    add('--every', type=int, default=1, metavar='N', help='take each N-th sweep (default: 1)')
    add('--labels', nargs='?', const='', metavar='FOLDER',
        help="SemanticKITTI's .label files; without a folder, the input's own labels")  # fmt: skip
    add('--sensor-height', type=float, metavar='M',
        help='of the LiDAR over base_link; for a saved map, which does not say it')  # fmt: skip
    add('--keep-moving', action='store_true', help='do not remove what sweeps saw through')
    add('--voxel', type=float, default=defaults.voxel, metavar='M', help='(default: %(default)s)')
    add('--max-range', type=float, default=defaults.max_range, metavar='M',
        help='(default: %(default)s)')  # fmt: skip
    add('--quiet', action='store_true', help='no progress bar')
    return parser


if __name__ == '__main__':
    sys.exit(main())
