"""`bags convert`: write any drive as a rosbag2 recording."""

import argparse
import signal
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from tqdm import tqdm

from bags.bag_messages import encode, static_transforms
from bags.input_arguments import add_input, add_span, drive_from
from bags.inputs import span_ns
from bags.mcap_writer import BagWriter
from bags.records import CameraImage, Drive, LidarScan, Record, TruthPose
from bags.topics import TOPICS
from lcd_common.errors import DataError

EXAMPLES = """examples:
  bags convert kitti/sequences/00 --out kitti_00          KITTI odometry, with images and truth
  bags convert kitti --sequence 07 --out kitti_07 --no-images
  bags convert 2011_10_03_drive_0027_sync --out raw_27    KITTI raw with OXTS as imu, gps and twist
  bags convert old.bag --out new --topic points=/velodyne_points --topic imu=
  bags convert cut_off.mcap --out saved                   whatever can still be read
  bags convert drive.mcap --out minute.mcap --start 60 --duration 60
  bags convert street --out street --columns 1800         the made-up town, as dense as an HDL-64E
  bags convert street:abrupt_u_turn --out spin --points-only
"""


def convert(
    drive: Drive,
    out: Path,
    *,
    start_s: float = 0.0,
    duration_s: float | None = None,
    kinds: Collection[type[Record]] | None = None,
    overwrite: bool = False,
    progress: bool = False,
) -> dict[str, int]:
    """Write a drive as a bag and return the number of messages of each topic.

    Args:
        drive: what to write.
        out: a new folder, or a new file when it ends in .mcap.
        start_s: seconds to leave out at the beginning.
        duration_s: seconds to write; None is to the end.
        kinds: the records to write; None is all.
        overwrite: replace a bag of that name.
        progress: show a bar on stderr.

    Raises:
        DataError: the drive is empty in the span, `out` exists, or the disk is full.
    """
    begin_ns, end_ns = span_ns(drive, start_s, duration_s)
    with (
        BagWriter(out, overwrite=overwrite) as bag,
        tqdm(total=_scans(drive, begin_ns, end_ns), unit='scan', disable=not progress) as bar,
    ):
        for number, record in enumerate(drive.records(begin_ns, end_ns, kinds)):
            if number == 0 and drive.mountings:
                bag.write(static_transforms(drive.mountings, record.stamp_ns))
            for message in encode(record, drive.camera):
                bag.write(message)
            bar.update(isinstance(record, LidarScan))
        if not bag.counts:
            raise DataError(
                f'{drive.path}: nothing to write in that span; bags info shows what is there'
            )
    return bag.counts


def add_parser(commands: Any) -> None:
    """Add the command to an argparse subparsers object."""
    parser = commands.add_parser(
        'convert',
        help='write any drive as a rosbag2 recording (mcap, zstd)',
        description='Write any drive as a rosbag2 recording (mcap, zstd) that ros2 bag and '
        'Foxglove read. It appears under its name when it is complete.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_input(parser)
    parser.add_argument(
        '--out', type=Path, required=True, help='new folder, or new file when it ends in .mcap'
    )
    add_span(parser)
    which = parser.add_mutually_exclusive_group()
    which.add_argument('--no-images', action='store_true', help='leave the camera out')
    which.add_argument(
        '--points-only', action='store_true', help='write /points and /tf_static alone'
    )
    parser.add_argument('--no-truth', action='store_true', help='leave /ground_truth/pose out')
    parser.add_argument('--overwrite', action='store_true', help='replace a bag of that name')
    parser.add_argument('--quiet', action='store_true', help='no progress bar')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Do what the command line says."""
    drive = drive_from(args)
    kinds = {LidarScan} if args.points_only else set(TOPICS)
    kinds -= {CameraImage} if args.no_images else set()
    kinds -= {TruthPose} if args.no_truth else set()
    with _termination_as_ctrl_c():
        counts = convert(
            drive,
            args.out,
            start_s=args.start,
            duration_s=args.duration,
            kinds=kinds,
            overwrite=args.overwrite,
            progress=not args.quiet,
        )
    written = ', '.join(f'{topic} {count}' for topic, count in counts.items())
    sys.stdout.write(f'{args.out}: {written}\n')
    for cause, count in sorted(drive.skipped.items()):
        sys.stdout.write(f'skipped: {count} x {cause}\n')
    return 0


def _scans(drive: Drive, begin_ns: int, end_ns: int | None) -> int | None:
    """Estimate the number of sweeps in the span, for the bar."""
    for stream in drive.streams():
        if stream.topic == TOPICS[LidarScan][0] or stream.type_name.endswith('PointCloud2'):
            if stream.first_ns is None or stream.last_ns is None or stream.count < 2:
                return stream.count
            last = stream.last_ns if end_ns is None else min(end_ns, stream.last_ns)
            share = (last - max(begin_ns, stream.first_ns)) / (stream.last_ns - stream.first_ns)
            return max(0, round(share * (stream.count - 1)) + 1)
    return None


@contextmanager
def _termination_as_ctrl_c() -> Iterator[None]:
    """Let a polite kill clean up as Ctrl-C does."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
