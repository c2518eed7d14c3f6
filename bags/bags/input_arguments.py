"""The arguments that all commands share: which drive, and which part of it."""

import argparse

from bags.drives import FORMATS
from bags.inputs import is_street, open_input
from bags.records import Drive
from lcd_common.errors import DataError


def add_input(parser: argparse.ArgumentParser) -> None:
    """Add INPUT and what tells how to read it."""
    parser.add_argument(
        'input',
        metavar='INPUT',
        help='a bag (.mcap, .db3, .bag or folder), a data set folder, street (a small made-up '
        'town), or town:SEED[:RUN] (a simulated one; see bags simulate)',
    )
    parser.add_argument('--format', choices=FORMATS, help='of a folder that is not recognised')
    parser.add_argument('--sequence', metavar='NN', help='of a data set that holds several')
    parser.add_argument(
        '--topic',
        action='append',
        default=[],
        metavar='ROLE=TOPIC',
        help='read a role of a bag (points, image, camera_info, imu, gnss, twist, truth) from this '
        'topic; an empty one leaves the role out; repeat for more',
    )
    street = parser.add_argument_group(
        'the small made-up town', 'INPUT street or street:ROUTE, with ROUTE loop or abrupt_u_turn'
    )
    street.add_argument('--seed', type=int, default=0, help='another town (default: %(default)s)')
    street.add_argument(
        '--columns', type=int, default=720, help='azimuth steps of a sweep (default: %(default)s)'
    )
    street.add_argument(
        '--point-time', action='store_true', help='sweep while driving, with a time for each point'
    )


def add_span(parser: argparse.ArgumentParser) -> None:
    """Add --start and --duration."""
    parser.add_argument(
        '--start', type=_seconds, default=0.0, metavar='S', help='leave out the first S seconds'
    )
    parser.add_argument('--duration', type=_seconds, metavar='S', help='take S seconds only')


def drive_from(args: argparse.Namespace) -> Drive:
    """Open the drive that the arguments name; raises DataError or ConfigError."""
    if is_street(args.input):
        from bags.street import LidarConfig, StreetConfig, StreetDrive

        return StreetDrive(
            args.input.partition(':')[2] or 'loop',
            StreetConfig(seed=args.seed),
            LidarConfig(columns=args.columns, point_time=args.point_time),
        )
    return open_input(
        args.input, format=args.format, sequence=args.sequence, topics=_roles(args.topic)
    )


def _roles(pairs: list[str]) -> dict[str, str]:
    """Read ROLE=TOPIC (or ROS's ROLE:=TOPIC)."""
    roles = {}
    for pair in pairs:
        role, equals, topic = pair.replace(':=', '=', 1).partition('=')
        if not equals:
            raise DataError(
                f'--topic expects ROLE=TOPIC, e.g. points=/velodyne_points, got {pair!r}'
            )
        roles[role] = topic
    return roles


def _seconds(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < 1e9:
        raise argparse.ArgumentTypeError(f'seconds must be zero or more, got {text}')
    return value
