"""Run odometry, loop closure and pose graph in one process: three constructors and spin.

python examples/slam_in_one_process.py --points /velodyne_points
python examples/slam_in_one_process.py --sim-time      beside: bags play drive.mcap
python examples/slam_in_one_process.py --map ~/maps/campus --ros-args -r __ns:=/car
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


def main(argv: Sequence[str] | None = None) -> int:
    """Compose the nodes; what follows --ros-args reaches all of them."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--points', default='points', help='topic of the clouds')
    parser.add_argument('--map', default='', help='folder of a saved map to go on in')
    parser.add_argument('--sim-time', action='store_true', help='follow /clock')
    options, rest = parser.parse_known_args(argv)
    if rest and '--ros-args' not in rest:
        parser.error(f'unrecognized arguments: {" ".join(rest)}')

    rclpy.init(args=rest)
    remap = ['--ros-args', '-r', f'points:={options.points}']
    clock = {'use_sim_time': options.sim_time}
    return command_line.run(
        lambda: spin(
            LidarOdometryNode(cli_args=remap, parameter_overrides=overrides(**clock)),
            LoopClosureNode(
                cli_args=remap, parameter_overrides=overrides(map=options.map, **clock)
            ),
            PoseGraphNode(parameter_overrides=overrides(map=options.map, **clock)),
        )
    )


if __name__ == '__main__':
    sys.exit(main())
