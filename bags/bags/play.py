"""`bags play`: publish a drive as if it were happening now."""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from bags.input_arguments import add_input, add_span, drive_from
from lcd_common.errors import DataError

EXAMPLES = """examples:
  bags play drive.mcap                                   at 1x, with /clock
  bags play drive.mcap --wait-for 2 --rate 0.5           starts when two nodes listen to /points
  bags play kitti/sequences/00 --start 60 --duration 30
  bags play drive --loop 10 --shift-stamps               ten times, as one long drive
  bags play drive --loop                                 for ever; stamps jump back each time
  bags play drive --topics /points /imu --best-effort
  bags play drive --ros-args -r /points:=/velodyne_points

keys, on a terminal: space pauses and goes on, s steps to the next sweep, q ends
nodes that follow the recorded time need use_sim_time:=true
"""


@dataclass(frozen=True)
class PlayOptions:
    """How to play.

    Attributes:
        rate: recorded seconds per second.
        start_s: seconds to leave out at the beginning.
        duration_s: seconds to play; None is to the end.
        rounds: how often; None is for ever.
        shift_stamps: let stamps go on increasing in later rounds.
        paused: begin paused.
        best_effort: publish best effort instead of reliable.
        wait_for: subscribers of the points to wait for before the first message.
        clock_hz: how often /clock is published; 0 is never.
        keyboard: take keys from a terminal.
        progress: show a bar on stderr.
    """

    rate: float = 1.0
    start_s: float = 0.0
    duration_s: float | None = None
    rounds: int | None = 1
    shift_stamps: bool = False
    paused: bool = False
    best_effort: bool = False
    wait_for: int = 0
    clock_hz: float = 100.0
    keyboard: bool = False
    progress: bool = False


def add_parser(commands: Any) -> None:
    """Add the command to an argparse subparsers object."""
    parser = commands.add_parser(
        'play',
        help='publish a drive as if it were happening now',
        description='Publish a drive with its timing, and /clock. /tf_static is latched.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_input(parser)
    add_span(parser)
    parser.add_argument(
        '--rate', type=_positive, default=1.0, metavar='X', help='times real time (default: 1)'
    )
    parser.add_argument(
        '--loop',
        type=int,
        nargs='?',
        const=0,
        default=1,
        metavar='N',
        help='play N times, or for ever without a number',
    )
    parser.add_argument(
        '--shift-stamps',
        action='store_true',
        help='let stamps increase from round to round; otherwise they jump back',
    )
    parser.add_argument('--paused', action='store_true', help='begin paused')
    parser.add_argument('--topics', nargs='+', metavar='TOPIC', help='play these topics only')
    parser.add_argument(
        '--best-effort', action='store_true', help='do not resend what gets lost on the way'
    )
    parser.add_argument(
        '--wait-for',
        type=int,
        default=0,
        metavar='N',
        help='begin when N nodes subscribe to the points',
    )
    parser.add_argument(
        '--clock', type=float, default=100.0, metavar='HZ', help='rate of /clock; 0 is none'
    )
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Do what the command line says."""
    if args.loop < 0:
        raise DataError(f'--loop expects a number of rounds, got {args.loop}')
    options = PlayOptions(
        rate=args.rate,
        start_s=args.start,
        duration_s=args.duration,
        rounds=args.loop or None,
        shift_stamps=args.shift_stamps,
        paused=args.paused,
        best_effort=args.best_effort,
        wait_for=args.wait_for,
        clock_hz=args.clock,
        keyboard=True,
        progress=not args.quiet,
    )
    drive = drive_from(args)
    try:
        from bags.nodes.play import play_on_ros
    except ModuleNotFoundError as error:
        raise DataError(
            f'bags play needs ROS 2, but {error.name} is not installed; source ROS or install its '
            'wheels (requirements/ros.txt)'
        ) from None
    return play_on_ros(drive, args.topics, options, args.ros_arguments)


def split_ros_arguments(arguments: Sequence[str]) -> tuple[list[str], list[str]]:
    """Split off what follows --ros-args (remaps, for rclpy)."""
    if '--ros-args' not in arguments:
        return list(arguments), []
    at = list(arguments).index('--ros-args')
    return list(arguments[:at]), list(arguments[at:])


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f'the rate must be above zero, got {text}')
    return value
