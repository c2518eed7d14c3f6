"""A made-up street through the real nodes in lock-step: before, after, loops, map, figures."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bags.records import Record
from bags.street import StreetConfig, StreetDrive
from bags.street.lidar import LidarConfig
from lcd_common.errors import ConfigError
from lcd_loop_closure.report.drive_evaluation import evaluate_drive
from lcd_loop_closure.report.loop_evaluation import Verdict
from lcd_loop_closure.report.result import DriveResult
from lcd_loop_closure.report.run_drive import main

pytestmark = pytest.mark.ros
SECONDS = 48.0  # until a street has been driven for the second time


def street() -> StreetDrive:
    """Return the town block with a coarse scanner at half the rate: seconds, not minutes."""
    settings = StreetConfig(imu_rate=0.0, gnss_rate=0.0)
    return StreetDrive('loop', settings, LidarConfig(columns=360, rate=5.0))


@pytest.fixture(scope='module')
def result() -> DriveResult:
    from lcd_loop_closure.nodes.offline_slam import drive_through

    return drive_through(street(), source='street', duration_s=SECONDS, progress=False)


def test_every_scan_has_odometry_and_a_corrected_pose(result: DriveResult) -> None:
    scans = round(SECONDS * 5.0) + 1
    assert len(result.scan_stamps_ns) == len(result.odometry) == len(result.corrected()) == scans
    assert set(result.keyframes.stamps_ns) <= set(result.scan_stamps_ns)
    assert result.recorded_s == SECONDS and result.wall_s > 0 and not result.interrupted


def test_loops_are_found_and_none_is_false(result: DriveResult) -> None:
    evaluation = evaluate_drive(result)
    assert evaluation.loops is not None and evaluation.after is not None
    assert evaluation.loops.count(Verdict.FALSE) == 0
    assert evaluation.loops.recall is not None and evaluation.loops.recall > 0.8
    assert evaluation.after.end_error_m < 0.3
    assert all(loop.reason for loop in result.loops if not loop.accepted)


def test_the_map_lies_where_the_walls_are(result: DriveResult) -> None:
    assert result.map_cloud is not None and len(result.map_cloud) > 10_000
    reach = np.abs(result.map_cloud.xyz[:, :2]).max()
    assert 50 < reach < 250
    assert result.graph is not None
    assert result.graph.T_world_body is not None
    np.testing.assert_array_equal(result.graph.T_world_body, result.keyframes.T_world_body)
    links = len(result.keyframes) - 1
    assert len(result.graph.edges) - links == len(result.accepted)


def test_stages_of_every_node_are_timed(result: DriveResult) -> None:
    assert set(result.stage_times_ms) == {'/lidar_odometry', '/loop_closure', '/pose_graph'}
    for stages in result.stage_times_ms.values():
        assert stages and all(min(times) >= 0 for times in stages.values())


def test_one_thread_repeats_to_the_last_bit() -> None:
    # The first odometry of a process decides on its threads: this one must be its own.
    script = """
import hashlib
from bags.street import StreetDrive
from lcd_loop_closure.nodes.offline_slam import drive_through
for _ in range(2):
    r = drive_through(StreetDrive(), source='', duration_s=4, threads=1, progress=False)
    poses = r.corrected().T_world_body.tobytes() + r.keyframes.T_world_body.tobytes()
    print(len(r.odometry), hashlib.sha256(poses).hexdigest())
"""
    run = subprocess.run([sys.executable, '-c', script], capture_output=True, text=True, check=True)
    first, second = run.stdout.splitlines()
    assert first == second and first.startswith('41 ')


def test_all_threads_repeat_within_a_nanometre() -> None:
    """Their sums end in other bits on every run; on a machine with one core they do not."""
    script = """
import numpy as np
from bags.street import StreetConfig, StreetDrive
from bags.street.lidar import LidarConfig
from bags.street.route import Route
from lcd_loop_closure.nodes.offline_slam import drive_through
corners = [(0, 0), (50, 0), (50, 40), (0, 40), (0, 0), (30, 0)]
results = []
for _ in range(2):
    route = Route(speed=25.0, corner_radius=8.0).through(corners)
    settings = StreetConfig(imu_rate=0.0, gnss_rate=0.0)
    drive = StreetDrive(route, settings, LidarConfig(columns=200, rate=4.0))
    options = {'detector': 'scan_context', 'duration_s': 27.0, 'progress': False}
    results.append(drive_through(drive, source='', threads=0, **options))
first, second = results
assert first.accepted and len(first.odometry) == 109
assert [(l.match_id, l.query_id, l.status) for l in first.loops] == [
    (l.match_id, l.query_id, l.status) for l in second.loops]
for a, b in (
    (first.odometry, second.odometry),
    (first.keyframes, second.keyframes),
    (first.corrected(), second.corrected()),
):
    assert np.array_equal(a.stamps_ns, b.stamps_ns)
    print(np.abs(a.T_world_body - b.T_world_body).max())
"""
    command = [sys.executable, '-c', script]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    differences = [float(line) for line in run.stdout.splitlines()]
    assert len(differences) == 3 and max(differences) < 1e-9


def test_parameter_files_reach_the_nodes(tmp_path: Path) -> None:
    from lcd_loop_closure.nodes.offline_slam import drive_through

    file = tmp_path / 'far.yaml'
    file.write_text('/loop_closure:\n  ros__parameters:\n    keyframes:\n      distance: 8.0\n')
    few = drive_through(street(), source='', duration_s=8.0, parameter_files=[file], progress=False)
    apart = np.linalg.norm(np.diff(few.keyframes.positions, axis=0), axis=1)
    assert len(apart) and apart.min() > 7.0
    file.write_text('/loop_closure:\n  ros__parameters:\n    keyframes:\n      distance: -1.0\n')
    with pytest.raises(ConfigError, match='distance'):
        drive_through(street(), source='', parameter_files=[file], progress=False)


class Interrupted(StreetDrive):
    """A street on which somebody presses Ctrl-C after three seconds."""

    def records(self, *given: Any, **options: Any) -> Iterator[Record]:
        first = self.streams()[0].first_ns
        assert first is not None
        for record in super().records(*given, **options):
            if record.stamp_ns > first + 3_000_000_000:
                raise KeyboardInterrupt
            yield record


@pytest.mark.parametrize('threads', [0, 1])
def test_an_interrupted_drive_keeps_all_that_was_driven(threads: int) -> None:
    from lcd_loop_closure.nodes.offline_slam import drive_through

    drive = Interrupted('loop', street().settings, LidarConfig(columns=240, rate=5.0))
    options: dict[str, Any] = {'source': '', 'detector': 'scan_context', 'progress': False}
    result = drive_through(drive, threads=threads, **options)
    assert result.interrupted and len(result.odometry) == 16
    # The last keyframe is there too: nothing was left in the process beside.
    travelled = np.linalg.norm(result.odometry.positions[-1] - result.keyframes.positions[-1])
    assert len(result.keyframes) >= 8 and travelled < 3.0
    assert [*result.counts] == ['/lidar_odometry', '/loop_closure', '/pose_graph']


def test_nothing_of_the_environment_is_left_changed() -> None:
    from lcd_loop_closure.nodes.offline_slam import own_context

    before = dict(os.environ)
    with own_context() as context:
        assert context.ok()
        assert dict(os.environ) == before
    assert not context.ok()


def test_the_command_writes_a_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / 'out'
    options = ['--duration', '3', '--out', str(out), '--threads', '1', '--quiet']
    assert main(options) == 0
    assert '31 of 31 scans' in capsys.readouterr().out
    assert (out / 'report.html').is_file() and (out / 'plots' / 'overview.png').is_file()
