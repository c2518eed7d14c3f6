"""Run SLAM with place recognition: uncertain loops are not tried, a kidnapped start is found.

python examples/slam_with_place_recognition.py --points /velodyne_points
python examples/slam_with_place_recognition.py --sim-time      beside: bags play drive.mcap
python examples/slam_with_place_recognition.py --map ~/maps/campus --places ~/maps/campus_places
"""

import argparse
import sys
from collections.abc import Sequence

import rclpy

from lcd_common import command_line
from lcd_common.nodes.parameters import overrides
from lcd_common.nodes.spin import spin
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode
from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode


def main(argv: Sequence[str] | None = None) -> int:
    """Compose the nodes; what follows --ros-args reaches all of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--points', default='points', help='topic of the clouds')
    parser.add_argument('--map', default='', help='folder that pose_graph saved, to go on in')
    parser.add_argument('--places', default='', help='folder that place_recognition saved then')
    parser.add_argument('--weights', default='', help='an ensemble; the one that ships by default')
    parser.add_argument('--sim-time', action='store_true', help='follow /clock')
    options, rest = parser.parse_known_args(argv)
    if rest and '--ros-args' not in rest:
        parser.error(f'unrecognized arguments: {" ".join(rest)}')

    rclpy.init(args=rest)
    remap = ['--ros-args', '-r', f'points:={options.points}']
    common = {'use_sim_time': options.sim_time}
    recognition = {'follow': 'keyframes', 'map': options.places, 'weights': options.weights}
    gated = overrides(gate__use=True, map=options.map, **common)
    # Only a map that the pose graph loads, too, is one to be found in.
    found = overrides(relocalize=bool(options.places), **recognition, **common)
    return command_line.run(
        lambda: spin(
            LidarOdometryNode(cli_args=remap, parameter_overrides=overrides(**common)),
            LoopClosureNode(cli_args=remap, parameter_overrides=gated),
            PoseGraphNode(parameter_overrides=overrides(map=options.map, **common)),
            PlaceRecognitionNode(cli_args=remap, parameter_overrides=found),
        )
    )


if __name__ == '__main__':
    sys.exit(main())
