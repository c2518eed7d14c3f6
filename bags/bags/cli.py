"""`bags`: convert, inspect, replay and simulate drives."""

import argparse
import sys
from functools import partial

from bags import convert, info, play, simulate
from lcd_common import command_line

EXAMPLES = """examples:
  bags info kitti/sequences/00
  bags convert kitti/sequences/00 --out kitti_00
  bags play kitti_00 --wait-for 2
  bags play street --rate 2 --loop --shift-stamps
  bags simulate --town 3 --length 3000 --imu --gnss --out town3.mcap
"""


def main(argv: list[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog='bags',
        description='Read drives of many formats, write them as rosbag2, replay and simulate them.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    commands = parser.add_subparsers(required=True, metavar='COMMAND')
    for command in (convert, info, play, simulate):
        command.add_parser(commands)
    arguments = sys.argv[1:] if argv is None else argv
    ours, ros = play.split_ros_arguments(arguments)
    args = parser.parse_args(ours)
    args.ros_arguments = ros
    return command_line.run(partial(args.run, args))


if __name__ == '__main__':
    sys.exit(main())
