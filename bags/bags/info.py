"""`bags info`: say what a drive holds."""

import argparse
import sys
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import islice
from typing import Any

import numpy as np
from tqdm import tqdm

from bags.input_arguments import add_input, drive_from
from bags.records import Drive, LidarScan, Mounting
from lcd_common import se3

EXAMPLES = """examples:
  bags info drive.mcap
  bags info kitti/sequences/00
  bags info 2011_10_03_drive_0027_sync --full      read all of it and count what is broken
  bags info street:abrupt_u_turn
"""


def describe(drive: Drive, *, full: bool = False, progress: bool = False) -> Iterator[str]:
    """Yield lines that describe a drive.

    Args:
        drive: the drive; its first sweep is read.
        full: read every record, so that everything unreadable is found and counted.
        progress: show a bar on stderr while reading.
    """
    yield f'{drive.name}  ({drive.path})'
    streams = drive.streams()
    spans = [
        (s.first_ns, s.last_ns) for s in streams if s.first_ns is not None and s.last_ns is not None
    ]
    if spans:
        first, last = min(a for a, _ in spans), max(b for _, b in spans)
        yield f'span      {_date(first)} to {_date(last)}, {(last - first) * 1e-9:.1f} s'
    else:
        yield 'span      empty'
    yield 'topics'
    rows: list[tuple[str, ...]] = [('topic', 'type', 'count', 'rate')]
    for s in streams:
        seconds = 0 if s.first_ns is None or s.last_ns is None else (s.last_ns - s.first_ns) * 1e-9
        rate = f'{(s.count - 1) / seconds:.2f} Hz' if seconds > 0 and s.count > 1 else '-'
        rows.append((s.topic, s.type_name, str(s.count), rate))
    yield from _table(rows)
    if drive.mountings:
        yield 'frames    parent -> child: x y z [m], roll pitch yaw [deg]'
        yield from (f'  {_mounting(mounting)}' for mounting in drive.mountings)
    else:
        yield 'frames    none: nodes need /tf_static from elsewhere'
    if drive.camera is not None:
        K = drive.camera.K
        yield (
            f'camera    {drive.camera.width} x {drive.camera.height}, fx {K[0, 0]:.1f} '
            f'fy {K[1, 1]:.1f} cx {K[0, 2]:.1f} cy {K[1, 2]:.1f}'
        )
    scan = next(islice(drive.records(kinds=(LidarScan,)), 1), None)
    if isinstance(scan, LidarScan):
        yield f'sweep     {_sweep(scan)}'
    truth = drive.truth()
    if truth is None:
        yield 'truth     none'
    else:
        yield f'truth     {len(truth)} poses of base_link over {truth.length_m:.1f} m'
    if full:
        for _ in tqdm(drive.records(), unit='record', disable=not progress):
            pass
    how = 'in all of it' if full else 'so far; --full reads everything'
    yield f'skipped   {sum(drive.skipped.values()) or "nothing"} ({how})'
    yield from (f'  {count} x {cause}' for cause, count in sorted(drive.skipped.items()))


def add_parser(commands: Any) -> None:
    """Add the command to an argparse subparsers object."""
    parser = commands.add_parser(
        'info',
        help='say what a drive holds',
        description='Say what a drive holds: topics, counts, rates, span, frames, point fields.',
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_input(parser)
    parser.add_argument('--full', action='store_true', help='read everything and count the broken')
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Do what the command line says."""
    for line in describe(drive_from(args), full=args.full, progress=True):
        sys.stdout.write(line + '\n')
    return 0


def _date(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns * 1e-9, UTC).strftime('%Y-%m-%d %H:%M:%S.%f')[:-3]


def _table(rows: list[tuple[str, ...]]) -> Iterator[str]:
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    for row in rows:
        cells = [text.ljust(width) for text, width in zip(row[:2], widths[:2], strict=True)]
        cells += [text.rjust(width) for text, width in zip(row[2:], widths[2:], strict=True)]
        yield '  ' + '  '.join(cells)


def _mounting(mounting: Mounting) -> str:
    T = mounting.T_parent_child
    x, y, z = T[:3, 3]
    R = T[:3, :3]
    roll = np.degrees(np.arctan2(R[2, 1], R[2, 2]))
    pitch = np.degrees(np.arcsin(np.clip(-R[2, 0], -1.0, 1.0)))
    yaw = np.degrees(se3.yaw(T))
    roll, pitch, yaw = (round(float(angle), 2) + 0.0 for angle in (roll, pitch, yaw))  # no -0.00
    return (
        f'{mounting.parent} -> {mounting.child}: {x:.3f} {y:.3f} {z:.3f}, '
        f'{roll:.2f} {pitch:.2f} {yaw:.2f}'
    )


def _sweep(scan: LidarScan) -> str:
    cloud = scan.cloud
    fields = 'x y z' + (' intensity' if cloud.intensity is not None else '')
    fields += ' label' if cloud.label is not None else ''
    if cloud.time_s is None:
        time = 'no time per point'
    else:
        time = f'time {cloud.time_s.min():.4f} to {cloud.time_s.max():.4f} s after the stamp'
    distance = np.linalg.norm(cloud.xyz, axis=1)
    reach = f'{distance.min():.1f} to {distance.max():.1f} m away, ' if len(cloud) else ''
    return f'{len(cloud)} points in frame {scan.frame_id}, {reach}{fields}, {time}'
