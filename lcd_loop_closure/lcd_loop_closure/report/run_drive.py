"""Drive a recording through the nodes and report on it: a drive in, a corrected trajectory out.

Odometry, loop closure and pose graph run as on a vehicle, but in lock-step: message by message,
nothing lost, as fast as the machine can.
"""

import argparse
import shutil
import sys
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path

from bags.drives import FORMATS
from bags.inputs import is_street, is_town, open_input, span_ns
from bags.records import Drive
from lcd_common import se3
from lcd_common.command_line import run
from lcd_common.errors import ConfigError, DataError
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report.drive_evaluation import DriveEvaluation, evaluate_drive
from lcd_loop_closure.report.reference import mounting_in_base, read_reference
from lcd_loop_closure.report.result import DriveResult
from lcd_loop_closure.report.result_folder import check_folder, write_result
from lcd_loop_closure.report.summary import summary

_EXAMPLES = """
examples:
  run_drive                                        a simulated town; see results/town_36_run0
  run_drive town:3                                 1.5 km in another; town:3:1 on another day
  run_drive street:abrupt_u_turn                   a small made-up street and its routes
  run_drive drive.mcap --out results/monday        a rosbag2 (mcap, sqlite3) or rosbag1
  run_drive kitti/sequences/00                     KITTI, KITTI-360, MulRan, Argoverse 2
  run_drive kitti --sequence 07 --threads 1        byte for byte the same on every run
  run_drive drive.mcap --topic points:=/velodyne_points --topic imu:=
  run_drive drive.mcap --start 60 --duration 120   two minutes of it, from the first minute on
  run_drive drive.mcap --params loop_closure.yaml --params pose_graph.yaml
  run_drive drive.mcap --truth truth.tum           judge against TUM or KITTI poses of base_link
  run_drive kitti/sequences/08 --truth 08.txt --truth-frame camera

Ctrl-C ends the drive early and still reports on what was driven; a second one ends at once.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _run(arguments))


def _run(arguments: argparse.Namespace) -> int:
    made_up = is_street(arguments.input) or is_town(arguments.input)
    if made_up and (arguments.format or arguments.sequence or arguments.topic):
        raise ConfigError('--format, --sequence and --topic choose from a recording; name one')
    drive = open_input(
        arguments.input,
        format=arguments.format,
        sequence=arguments.sequence,
        topics=_topics(arguments.topic),
    )
    out = arguments.out or Path('results') / drive.name
    check_folder(out, arguments.overwrite)
    span_ns(drive, arguments.start, arguments.duration)
    for path in arguments.params:
        if not path.is_file():
            raise ConfigError(f'{path}: expected a ROS parameter file, found none; check the path')
    reference = None if arguments.truth is None else _reference(arguments, drive)

    # After the arguments are checked: it takes seconds to import.
    from lcd_loop_closure.nodes.offline_slam import drive_through

    result = drive_through(
        drive,
        source=arguments.input,
        start_s=arguments.start,
        duration_s=arguments.duration,
        threads=arguments.threads,
        detector=arguments.detector,
        parameter_files=arguments.params,
        progress=not arguments.quiet,
    )
    if reference is not None:
        result = result.with_truth(reference(result))
    if not len(result.odometry):
        raise DataError(_why_nothing(result))
    evaluation = evaluate_drive(result)
    report = write_result(result, evaluation, out, plots=not arguments.no_plots)
    _show(arguments, result, evaluation, report)
    return 130 if result.interrupted else 0


def _show(
    arguments: argparse.Namespace, result: DriveResult, evaluation: DriveEvaluation, report: Path
) -> None:
    sys.stdout.write(summary(result, evaluation) + f'\nreport     {report}\n')
    overview = report.parent / 'plots' / 'overview.png'
    if arguments.picture is not None and overview.is_file():
        arguments.picture.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(overview, arguments.picture)
    if arguments.open:
        webbrowser.open(report.resolve().as_uri())


def _topics(texts: Sequence[str]) -> dict[str, str] | None:
    topics = {}
    for text in texts:
        role, arrow, topic = text.partition(':=')
        if not arrow:
            raise ConfigError(f'--topic must be ROLE:=TOPIC, e.g. points:=/velodyne, got {text!r}')
        topics[role.lstrip('/')] = topic
    return topics or None


def _reference(arguments: argparse.Namespace, drive: Drive) -> Callable[[DriveResult], Trajectory]:
    """Read the reference now, so that a mistake shows at once; it needs the scans' times later."""
    T_base_body = mounting_in_base(drive.mountings, arguments.truth_frame)
    reference = read_reference(arguments.truth)
    return lambda result: reference.trajectory(result.scan_stamps_ns, se3.inverse(T_base_body))


def _why_nothing(result: DriveResult) -> str:
    causes = [f'{cause} ({count})' for cause, count in result.skipped.items() if count]
    causes += [
        f'{node.strip("/")}: {cause} ({count})'
        for node, counts in result.counts.items()
        for cause, count in counts.items()
        if count
    ]
    return (
        f'{result.source}: none of {len(result.scan_stamps_ns)} scans got odometry, nothing to '
        f'report: {"; ".join(causes) or "the recording has no scans in this span"}'
    )


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='run_drive',
        description=__doc__,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add('input', nargs='?', default='town', metavar='INPUT',
        help='bag, data set folder, town[:SEED[:RUN]], street[:ROUTE] (default: town)')  # fmt: skip
    add('--out', type=Path, metavar='FOLDER', help='for the results (default: results/NAME)')
    add('--overwrite', action='store_true', help='replace earlier results in the folder')
    add('--format', choices=list(FORMATS), help='format of INPUT (default: recognised)')
    add('--sequence', metavar='NAME', help='which sequence of a data set, e.g. 00')
    add('--topic', action='append', default=[], metavar='ROLE:=TOPIC',
        help='topic of a bag to read as points, imu, …; empty: none (repeatable)')  # fmt: skip
    add('--params', type=Path, action='append', default=[], metavar='YAML',
        help='ROS parameter file for the nodes (repeatable)')  # fmt: skip
    add('--threads', type=_count, metavar='N',
        help='threads of registration; 1 repeats exactly, in one process; 0: all')  # fmt: skip
    add('--detector', choices=('lcdnet', 'scan_context'),
        help='what finds loops by their looks (default: lcdnet)')  # fmt: skip
    add('--start', type=_seconds, default=0.0, metavar='S', help='leave out the first S seconds')
    add('--duration', type=_seconds, metavar='S', help='drive S seconds only')
    add('--truth', type=Path, metavar='FILE', help='reference poses: TUM or KITTI')
    add('--truth-frame', default='base_link', metavar='FRAME',
        help='frame whose poses they are (default: base_link)')  # fmt: skip
    add('--no-plots', action='store_true', help='draw no pictures')
    add('--picture', type=Path, metavar='PNG', help='write the overview picture here too')
    add('--quiet', action='store_true', help='show no progress')
    add('--open', action='store_true', help='open the report in a browser')
    return parser


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f'must be a whole number from 0 on, got {text!r}')
    return int(text)


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < 1e9:
        raise argparse.ArgumentTypeError(f'must be a number of seconds from 0 on, got {text!r}')
    return value


if __name__ == '__main__':
    sys.exit(main())
