"""Map a drive, then find and track the vehicle in that map by its camera: three parts, one bag.

    bags simulate --town 100 --length 300 --camera --imu --out drive.mcap
    python examples/map_then_localize.py drive.mcap --out mapped
    python examples/map_then_localize.py drive.mcap --map mapped --start 15    # the same map again

First pass: the pose graph places the sweeps, which become a LiDAR map, and place recognition
remembers its places. Second pass, from --start on: place recognition finds where the vehicle is,
map_registration refines that by each camera image, ekf fuses it with the IMU and owns
map -> base_link. Needs points, camera and imu; prints how far the second pass is off the first.
How well the camera holds the vehicle is a matter of its network (--weights).
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from tqdm import tqdm

from bags.inputs import open_input
from bags.nodes.lockstep import LockStep
from bags.records import Drive
from cmrnet_ekf.mapping.build import drive_sweeps
from cmrnet_ekf.mapping.map_builder import MapBuilder
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.mapping.tile_folder import TileFolder
from cmrnet_ekf.nodes.ekf_node import EkfNode
from cmrnet_ekf.nodes.map_registration_node import MapRegistrationNode
from lcd_common import command_line, se3
from lcd_common.errors import DataError
from lcd_common.nodes import messages
from lcd_common.nodes.parameters import overrides
from lcd_common.trajectory import Trajectory, read_tum
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode
from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode

POSES = 'poses.tum'  # of the mapped drive, beside tiles and places


def build(drive: Drive, out: Path) -> Trajectory:
    """Map a drive into out/tiles and out/places; return where its keyframes are in the map.

    Raises:
        DataError: out holds something: a map would grow by a second copy of the drive.
    """
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise DataError(f'{out}: is there already; --map {out} uses its map, or name a new --out')
    inside = {'parameter_overrides': overrides(threaded=False)}
    places = PlaceRecognitionNode(parameter_overrides=overrides(threaded=False, follow='keyframes'))
    graph = PoseGraphNode(**inside)
    _replay([LidarOdometryNode(**inside), LoopClosureNode(**inside), graph, places], drive)
    poses: Trajectory = graph.map.graph.trajectory()
    places.recognizer.save(out / 'places')
    builder = MapBuilder(TileFolder.create(out / 'tiles', MapConfig()), MapConfig())
    for sweep in tqdm(drive_sweeps(drive, poses, every=2), 'LiDAR map', unit='sweep'):
        builder.add(sweep.cloud, sweep.T_map_base, sweep.T_base_sensor, sweep.moving)
    builder.finish()
    poses.write_tum(out / POSES)
    return poses


def localize(drive: Drive, out: Path, start_s: float, weights: str) -> list[tuple[int, se3.Array]]:
    """Find and track the vehicle in the map; return what ekf says, stamps with T_map_base."""
    found: list[tuple[int, se3.Array]] = []

    def on_estimate(message: Odometry) -> None:
        stamp_ns = messages.stamp_ns(message.header.stamp)
        found.append((stamp_ns, messages.transform_from_pose(message.pose.pose)))

    def on_start(message: PoseWithCovarianceStamped) -> None:
        stamp_s = messages.stamp_ns(message.header.stamp) * 1e-9
        sys.stdout.write(f'found by place recognition at {stamp_s:.1f} s\n')

    inside: dict[str, Any] = {'threaded': False}
    known = overrides(map=str(out / 'places'), grow=False, relocalize=True, **inside)
    camera = overrides(map=str(out / 'tiles'), weights=weights, **inside)
    # LiDAR odometry only serves place recognition: ekf lives by camera and IMU.
    alone = overrides(odometry='', fixes='', start_from='set_pose')
    nodes = [
        # base_link has one parent, and that edge is ekf's.
        LidarOdometryNode(parameter_overrides=overrides(publish_tf=False, **inside)),
        PlaceRecognitionNode(parameter_overrides=known),
        MapRegistrationNode(parameter_overrides=camera),
        EkfNode(parameter_overrides=alone),
    ]
    listened = {'/odometry/filtered': on_estimate, '/initialpose': on_start}
    _replay(nodes, drive, start_s, listened)
    if not found:
        raise DataError('the vehicle was not found in the map; try another --start')
    return found


def _replay(nodes: Sequence[Any], drive: Drive, start_s: float = 0.0, listened: Any = None) -> None:
    try:
        lockstep = LockStep(nodes)
        for topic, callback in (listened or {}).items():
            lockstep.listen(topic, callback)
        lockstep.run(drive, start_s=start_s)
    finally:
        for node in nodes:
            node.destroy_node()


def run(options: argparse.Namespace) -> None:
    """Do both passes, or the second in an earlier map, and say how well they agree."""
    drive = open_input(options.source)
    if drive.camera is None:
        raise DataError(f'{options.source}: has no camera; bags simulate --camera --imu makes one')
    rclpy.init(args=[])
    try:
        poses = read_tum(options.map / POSES) if options.map else build(drive, options.out)
        found = localize(drive, options.map or options.out, options.start, options.weights)
    finally:
        rclpy.try_shutdown()
    mapped = [(T, poses.at(stamp_ns)) for stamp_ns, T in found]
    off = np.array([se3.distance(T, at) for T, at in mapped if at is not None])
    if not len(off):
        raise DataError('the first pass has no pose at the time of the second; try another --start')
    sys.stdout.write(
        f'{len(found)} poses by camera and IMU; off the first pass: '
        f'median {np.median(off[:, 0]):.2f} m, {np.degrees(np.median(off[:, 1])):.2f} degrees, '
        f'at most {off[:, 0].max():.2f} m\n'
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Read the command line and run both passes."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('source', help='bag or data set folder with points, camera and imu')
    folder = parser.add_mutually_exclusive_group(required=True)
    folder.add_argument('--out', type=Path, help='new folder for map and places')
    folder.add_argument(
        '--map', type=Path, help='--out of an earlier run of this drive: no mapping'
    )
    parser.add_argument(
        '--start', type=float, default=10.0, metavar='S', help='of the second pass (default: 10)'
    )
    parser.add_argument('--weights', default='', help='of CMRNet; those that ship by default')
    options = parser.parse_args(argv)
    return command_line.run(lambda: run(options))


if __name__ == '__main__':
    sys.exit(main())
