"""Write what a drive gave into one folder that is either whole or not there."""

import csv
import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_loop_closure.g2o import write_g2o
from lcd_loop_closure.report.cloud_files import write_pcd, write_ply
from lcd_loop_closure.report.drive_evaluation import DriveEvaluation, metrics
from lcd_loop_closure.report.figures import write_overview, write_pictures
from lcd_loop_closure.report.html_report import write_html
from lcd_loop_closure.report.loop_evaluation import JudgedLoop
from lcd_loop_closure.report.result import DriveResult

METRICS = 'metrics.json'
_COLUMNS = (
    'match_id', 'query_id', 'match_stamp_s', 'query_stamp_s', 'verdict', 'status', 'reason',
    'method',
    'descriptor_distance', 'fitness', 'rmse_m', 'inliers', 'overlap', 'false_match_probability',
    'x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw',
    'apart_m', 'translation_error_m', 'rotation_error_deg',
)  # fmt: skip


def check_folder(folder: Path, overwrite: bool) -> None:
    """Raise DataError unless results may be written to `folder`.

    An existing folder is replaced only on request, and only when it holds results: a folder named
    by mistake keeps what is in it.
    """
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not folder.is_dir():
        raise DataError(f'{folder} is a file; name a folder for the results')
    if not (folder / METRICS).is_file():
        raise DataError(f'{folder} holds other things than results; name another folder')
    if not overwrite:
        raise DataError(f'{folder} holds results already; name another folder or add --overwrite')


def write_result(
    result: DriveResult, evaluation: DriveEvaluation, folder: Path, *, plots: bool = True
) -> Path:
    """Write trajectories, loops, map, graph, figures, pictures and the report.

    Everything is written beside `folder` first and put in its place at the end, so that a kill in
    between leaves what was there before.

    Returns:
        The report's path.
    """
    with _replacing(folder) as new:
        result.odometry.write_tum(new / 'odometry.tum')
        evaluation.corrected.write_tum(new / 'corrected.tum')
        result.odometry.write_kitti(new / 'odometry_kitti.txt')
        evaluation.corrected.write_kitti(new / 'corrected_kitti.txt')
        result.keyframes.write_tum(new / 'keyframes.tum')
        if evaluation.truth_in_map is not None:
            evaluation.truth_in_map.write_tum(new / 'reference.tum')
        _write_loops(evaluation.judged, new)
        if result.map_cloud is not None:
            write_ply(result.map_cloud, new / 'map.ply')
            write_pcd(result.map_cloud, new / 'map.pcd')
        if result.graph is not None:
            write_g2o(new / 'graph.g2o', result.graph)
        figures = metrics(result, evaluation)
        pictures = write_pictures(result, evaluation, new / 'plots') if plots else ()
        if plots:
            write_overview(result, evaluation, new / 'plots' / 'overview.png')
        write_html(result, evaluation, figures, pictures, new / 'report.html')
        (new / METRICS).write_text(json.dumps(figures, indent=2) + '\n')
    return folder / 'report.html'


@contextmanager
def _replacing(folder: Path) -> Iterator[Path]:
    """Yield a new folder that takes the place of `folder` when the block ends well."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    new, old = folder.with_name(f'.{folder.name}.new'), folder.with_name(f'.{folder.name}.old')
    for left_over in (new, old):
        shutil.rmtree(left_over, ignore_errors=True)
    new.mkdir()
    try:
        yield new
        if folder.exists():
            folder.rename(old)
        new.rename(folder)
    finally:
        if not folder.exists() and old.exists():
            old.rename(folder)
        shutil.rmtree(new, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _write_loops(judged: tuple[JudgedLoop, ...], folder: Path) -> None:
    rows = [_row(j) for j in judged]
    with (folder / 'loops.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, _COLUMNS)
        writer.writeheader()
        for row in rows:
            writer.writerow({key: '' if value is None else value for key, value in row.items()})
    (folder / 'loops.json').write_text(json.dumps(rows, indent=1) + '\n')


def _row(j: JudgedLoop) -> dict[str, object]:
    loop = j.loop
    pose: list[float | None] = [None] * 7
    if loop.T_match_query is not None:
        T = loop.T_match_query
        pose = [float(v) for v in (*T[:3, 3], *se3.quaternion_from_rotation(T[:3, :3]))]
    values = (
        loop.match_id, loop.query_id, _seconds(loop.match_stamp_ns), _seconds(loop.query_stamp_ns),
        j.verdict.value, loop.status.name.lower(), loop.reason, loop.method,
        loop.descriptor_distance, loop.fitness, loop.rmse_m, loop.inliers, loop.overlap,
        loop.false_match_probability, *pose,
        j.apart_m, j.translation_error_m, j.rotation_error_deg,
    )  # fmt: skip
    return dict(zip(_COLUMNS, values, strict=True))


def _seconds(stamp_ns: int) -> str:
    # As text: seconds since 1970 with nanoseconds do not fit a float.
    return f'{stamp_ns // 1_000_000_000}.{stamp_ns % 1_000_000_000:09d}'
