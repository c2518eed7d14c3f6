"""Everything that a drive leaves behind is readable by other tools and written as a whole."""

import csv
import html.parser
import json
import re
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import open3d as o3d
import pytest
from evo.tools import file_interface
from PIL import Image

from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report import result_folder
from lcd_loop_closure.report.drive_evaluation import DriveEvaluation, evaluate_drive
from lcd_loop_closure.report.result import DriveResult


@pytest.fixture(scope='module')
def evaluation(result: DriveResult) -> DriveEvaluation:
    return evaluate_drive(result)


@pytest.fixture(scope='module')
def folder(
    result: DriveResult, evaluation: DriveEvaluation, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    folder = tmp_path_factory.mktemp('out') / 'eight'
    report = result_folder.write_result(result, evaluation, folder)
    assert report == folder / 'report.html'
    return folder


def test_evo_reads_the_trajectories(folder: Path, evaluation: DriveEvaluation) -> None:
    tum = file_interface.read_tum_trajectory_file(str(folder / 'corrected.tum'))
    kitti = file_interface.read_kitti_poses_file(str(folder / 'corrected_kitti.txt'))
    for read in (tum, kitti):
        np.testing.assert_allclose(read.positions_xyz, evaluation.corrected.positions, atol=1e-6)
    np.testing.assert_allclose(tum.timestamps, evaluation.corrected.stamps_ns * 1e-9)


def test_open3d_reads_the_map(folder: Path, result: DriveResult) -> None:
    assert result.map_cloud is not None
    for name in ('map.ply', 'map.pcd'):
        points = np.asarray(o3d.io.read_point_cloud(str(folder / name)).points)
        np.testing.assert_array_equal(points.astype(np.float32), result.map_cloud.xyz)


def test_gtsam_reads_the_graph(folder: Path, result: DriveResult) -> None:
    graph, poses = gtsam.readG2o(str(folder / 'graph.g2o'), True)
    assert poses.size() == len(result.keyframes) and graph.size() == len(result.keyframes) - 1


def test_loops_hold_verdict_and_reason(folder: Path) -> None:
    with (folder / 'loops.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 25 == len(json.loads((folder / 'loops.json').read_text()))
    assert rows[3]['status'] == 'rejected_fitness' and rows[3]['reason'].startswith('fitness 0.31')
    assert rows[5]['x_m'] == ''  # nothing was registered
    assert rows[6]['verdict'] == 'false' and float(rows[6]['translation_error_m']) > 4
    assert rows[0]['query_stamp_s'] == '1700000040.123456789'


def test_figures_are_those_of_the_drive(folder: Path) -> None:
    figures = json.loads((folder / 'metrics.json').read_text())
    assert figures['loops']['true'] == 20 and figures['loops']['false'] == 2
    assert figures['after']['ate_rmse_m'] < 0.1 < figures['before']['ate_rmse_m']
    assert figures['stages_ms']['/pose_graph']['update']['runs'] == 300
    text = ' '.join(figures['warnings'])
    assert 'truncated velodyne file' in text and 'NaN points' in text and '1 of 801' in text
    assert 'scans (800)' not in text  # a count of good things is no warning


def test_pictures_show_something(folder: Path) -> None:
    pictures = sorted((folder / 'plots').glob('*.png'))
    assert [p.stem for p in pictures] == [
        'error_over_time', 'loops_over_time', 'map', 'overview', 'stage_times', 'trajectory',
    ]  # fmt: skip
    for path in pictures:
        pixels = np.asarray(Image.open(path).convert('L'))
        assert 0.002 < (pixels < 250).mean() < 0.9, path.name
    assert (folder / 'plots' / 'overview.png').stat().st_size < 400_000


def test_report_is_one_whole_page_without_outside(folder: Path) -> None:
    page = (folder / 'report.html').read_text()
    parser = _Page()
    parser.feed(page)
    assert parser.open_tags == []
    assert len(parser.images) == 5
    assert all(source.startswith('data:image/png;base64,') for source in parser.images)
    assert not re.search(r'(href|src)="(?!data:)', page) and 'http' not in page
    assert 'prefers-color-scheme: dark' in page
    assert 'fitness 0.31, at least 0.6' in page and 'truncated velodyne file' in page


def test_texts_from_outside_cannot_break_the_page(result: DriveResult, tmp_path: Path) -> None:
    odd = replace(result, name='<script>alert(1)</script>', map_cloud=None, truth=None)
    result_folder.write_result(odd, evaluate_drive(odd), tmp_path / 'odd', plots=False)
    page = (tmp_path / 'odd' / 'report.html').read_text()
    assert '<script>' not in page and '&lt;script&gt;' in page


def test_a_short_drive_without_loops_or_reference_has_a_report(
    odometry: Trajectory, tmp_path: Path
) -> None:
    start = Trajectory(odometry.stamps_ns[:3], odometry.T_world_body[:3])
    first = Trajectory(odometry.stamps_ns[:1], odometry.T_world_body[:1])
    bare = DriveResult('bare', 'three scans', start, first)
    result_folder.write_result(bare, evaluate_drive(bare), tmp_path / 'bare')
    names = {path.name for path in (tmp_path / 'bare').rglob('*.*')}
    assert 'trajectory.png' in names and 'report.html' in names
    assert not names & {'map.ply', 'graph.g2o', 'error_over_time.png', 'stage_times.png'}


def test_results_are_replaced_only_on_request(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DataError, match='--overwrite'):
        result_folder.check_folder(folder, overwrite=False)
    result_folder.check_folder(folder, overwrite=True)
    (tmp_path / 'thesis.tex').write_text('precious')
    with pytest.raises(DataError, match='other things'):
        result_folder.check_folder(tmp_path, overwrite=True)
    with pytest.raises(DataError, match='is a file'):
        result_folder.check_folder(tmp_path / 'thesis.tex', overwrite=True)
    result_folder.check_folder(tmp_path / 'new', overwrite=False)


def test_a_failure_while_writing_leaves_the_old_results(
    folder: Path, result: DriveResult, evaluation: DriveEvaluation, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = (folder / 'metrics.json').read_bytes()

    def fail(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(result_folder, 'write_html', fail)
    with pytest.raises(KeyboardInterrupt):
        result_folder.write_result(result, evaluation, folder, plots=False)
    assert (folder / 'metrics.json').read_bytes() == before
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]


class _Page(html.parser.HTMLParser):
    """Collect images and check that tags close in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open_tags: list[str] = []
        self.images: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == 'img':
            self.images.append(dict(attrs)['src'] or '')
        if tag not in ('img', 'meta', 'br', 'link', 'input'):
            self.open_tags.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open_tags.pop() == tag
