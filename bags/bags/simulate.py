"""`bags simulate`: drive through a made-up town and record what the sensors see."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bags.convert import convert
from lcd_common.errors import ConfigError

if TYPE_CHECKING:
    from bags.simulation.drive import SimulatedDrive

EXAMPLES = """examples:
  bags simulate --town 3 --out town3.mcap                  1.5 km with a 64-beam LiDAR
  bags simulate --town 3 --length 3000 --runs 2 --camera --imu --gnss --out town3.mcap
                                                           town3_run0.mcap and town3_run1.mcap
  bags simulate --town 204 --reverse 0.4 --same-way 0 --out back.mcap
  bags simulate --town 3 --sensor os1_64 --point-time --imu mems --out os1.mcap
  bags simulate --town 3 --blocked 145 215 --out rear.mcap blind 70 degrees to the rear, as MulRan's
  bags simulate --town 7 --style aliased --length 1000 --out alike.mcap
  bags simulate --town 3 --camera --format kitti --out kitti_like
                                                           sequences/00, labels as SemanticKITTI's

towns 0-99 are for training, 100-109 for validation, 200-209 for tests; the same town, run and
options give the same bytes. Without a file: INPUT town:3 or town:3:1 (run 1) of the other commands.
"""


def add_parser(commands: Any) -> None:
    """Add the command to an argparse subparsers object."""
    parser = commands.add_parser(
        'simulate',
        help='drive through a made-up town and record it',
        description='Drive through a made-up town and record LiDAR, camera, IMU and satellites in '
        "KITTI's frames, with exact poses. Runs are the same streets at other times: other cars, "
        'leaves, light, lanes and noise.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('--out', type=Path, required=True,
        help='new bag (folder, or file that ends in .mcap), or root of --format kitti')  # fmt: skip
    add('--format', choices=('mcap', 'kitti'), default='mcap', help='(default: %(default)s)')
    add('--town', type=int, default=0, metavar='SEED', help='which town (default: %(default)s)')
    add('--style', help='of all its streets: urban, residential, avenue, industrial, open or '
        'aliased, where all houses are alike (default: a mixture)')  # fmt: skip
    add('--first-run', type=int, default=0, metavar='N', help='first run (default: %(default)s)')
    add('--runs', type=int, default=1, metavar='N', help='how many (default: %(default)s)')
    add('--length', type=float, default=1500.0, metavar='M', help='metres (default: %(default)s)')
    add('--same-way', type=float, metavar='SHARE',
        help='of the way driven again the same way (default: 0.2)')  # fmt: skip
    add('--reverse', type=float, metavar='SHARE',
        help='of the way driven again the other way (default: 0.1)')  # fmt: skip
    add('--crossing', type=float, metavar='SHARE',
        help='of the crossings passed again right across, on other streets; a town has few with '
        'four streets: about 0.1 is the most that comes out (default: 0.08)')  # fmt: skip
    add('--lateral', type=float, metavar='M',
        help='largest shift to the side when a street is driven again (default: 1)')  # fmt: skip
    add('--speed', type=float, metavar='M/S', help='top speed (default: 11)')
    add('--sensor', default='hdl64', metavar='NAME',
        help='hdl64, hdl64_kitti (calibrated as badly as KITTI\'s), os1_64, os1_64_mulran, vlp16 '
        'or beams32 (default: %(default)s)')  # fmt: skip
    add('--blocked', type=float, nargs=2, action='append', default=[], metavar=('BEGIN', 'END'),
        help='a sector that the LiDAR does not see: from one azimuth to the other, degrees '
        'counter-clockwise from straight ahead; -45 45 is the 90 degrees ahead. Several are '
        'several sectors')  # fmt: skip
    add('--point-time', action='store_true',
        help='sweep while driving, each point with its time; else deskewed')  # fmt: skip
    add('--dual-return', action='store_true',
        help='a point of each of two surfaces in a beam; else of the stronger')  # fmt: skip
    add('--no-labels', action='store_true',
        help="leave out each point's label (SemanticKITTI's numbers; 252 to 259 move)")  # fmt: skip
    add(
        '--camera', action='store_true', help="KITTI's left colour camera, an image with each sweep"
    )
    add('--imu', nargs='?', const='rt3003', default='', metavar='NAME',
        help='inertial unit at 100 Hz: rt3003 (when no name is given) or mems')  # fmt: skip
    add('--gnss', action='store_true', help='satellite receiver at 1 Hz')
    add('--overwrite', action='store_true', help='replace what has that name')
    add('--quiet', action='store_true', help='no progress bar')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Do what the command line says."""
    if args.town < 0 or args.first_run < 0 or args.runs < 1:
        raise ConfigError('--town and --first-run must be at least 0 and --runs at least 1')
    if args.format == 'kitti' and (args.imu or args.gnss or args.point_time or args.no_labels):
        raise ConfigError(
            "KITTI's odometry layout has no place for --imu, --gnss and --point-time, and always "
            'has labels; leave these options out or write --format mcap'
        )
    drives = _drives(args)
    for number, drive in enumerate(drives):
        plan = drive.journey.plan
        sys.stdout.write(
            f'{drive.name}: {drive.journey.duration_s:.0f} s, streets again the same way '
            f'{plan.same_way:.0%}, the other way {plan.reverse:.0%}, '
            f'crossings {plan.crossing:.0%}\n'
        )
        if args.format == 'kitti':
            out, counts = args.out / 'sequences' / f'{number:02d}', _kitti(drive, args, number)
        else:
            out = _name(args.out, drive.run) if len(drives) > 1 else args.out
            counts = convert(drive, out, overwrite=args.overwrite, progress=not args.quiet)
        written = ', '.join(f'{what} {count}' for what, count in counts.items())
        sys.stdout.write(f'{out}: {written}\n')
    return 0


def _drives(args: argparse.Namespace) -> 'list[SimulatedDrive]':
    # scipy and the town: only for those who simulate.
    from bags.simulation.drive import SensorsConfig, SimulatedDrive
    from bags.simulation.itinerary import JourneyConfig
    from bags.simulation.streetscape import STREETSCAPES
    from bags.simulation.town import SimulatedTown

    if args.style is not None and args.style not in STREETSCAPES:
        raise ConfigError(f'a style is one of {", ".join(STREETSCAPES)}, got {args.style!r}')
    asked = {
        name: getattr(args, name)
        for name in ('same_way', 'reverse', 'crossing', 'lateral', 'speed')
        if getattr(args, name) is not None
    }
    journey = JourneyConfig(length=args.length, **asked)
    sensors = SensorsConfig(
        lidar=args.sensor,
        blocked=tuple(azimuth for sector in args.blocked for azimuth in sector),
        point_time=args.point_time,
        dual_return=args.dual_return,
        labels=not args.no_labels,
        camera=args.camera,
        imu=args.imu,
        gnss=args.gnss,
    )
    town = SimulatedTown(args.town, args.style)
    runs = range(args.first_run, args.first_run + args.runs)
    return [SimulatedDrive(town, number, journey, sensors) for number in runs]


def _kitti(drive: 'SimulatedDrive', args: argparse.Namespace, number: int) -> dict[str, int]:
    from bags.simulation.kitti_writer import write_kitti

    return write_kitti(
        drive, args.out, f'{number:02d}', overwrite=args.overwrite, progress=not args.quiet
    )


def _name(out: Path, number: int) -> Path:
    return out.with_name(f'{out.stem}_run{number}{out.suffix}')
