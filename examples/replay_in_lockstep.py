"""Drive a recording through the nodes message by message, without DDS, and print the result.

python examples/replay_in_lockstep.py street                    a made-up drive
python examples/replay_in_lockstep.py drive.mcap --save-map maps/drive
python examples/replay_in_lockstep.py kitti/sequences/00 --duration 60
"""

import argparse
import sys
from collections.abc import Sequence

import rclpy

from bags.inputs import open_input
from bags.nodes.lockstep import LockStep
from lcd_common import command_line
from lcd_common.nodes.parameters import overrides
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.map_store import save_map
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode


def replay(source: str, duration_s: float | None, save_to: str) -> None:
    """Make the nodes, feed them, and say what came out."""
    drive = open_input(source)  # a wrong path is said before any node starts
    rclpy.init(args=[])
    inside = overrides(threaded=False)  # work inside the callbacks: the same result on every run
    classes = (LidarOdometryNode, LoopClosureNode, PoseGraphNode)
    nodes = [cls(parameter_overrides=inside) for cls in classes]
    try:
        LockStep(nodes).run(drive, duration_s=duration_s)
        graph = nodes[-1].map.graph
        accepted = sum(loop.status is LoopStatus.ACCEPTED for loop in graph.loops())
        sys.stdout.write(
            f'{len(graph)} keyframes, {graph.trajectory().length_m:.0f} m, {accepted} loops\n'
        )
        if save_to:
            sys.stdout.write(f'map saved in {save_map(nodes[-1].map.saved(), save_to)}\n')
    finally:
        for node in nodes:
            node.destroy_node()
        rclpy.try_shutdown()


def main(argv: Sequence[str] | None = None) -> int:
    """Read the command line and replay."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('source', help='bag, data set folder, or street')
    parser.add_argument('--duration', type=float, help='seconds to replay; all of it by default')
    parser.add_argument('--save-map', default='', help='folder for the map')
    options = parser.parse_args(argv)
    return command_line.run(lambda: replay(options.source, options.duration, options.save_map))


if __name__ == '__main__':
    sys.exit(main())
