"""The command around the nodes: what it asks of them, what it writes, what it says of mistakes.

The drive itself is replaced here by a ready result; tests/system drives the nodes.
"""

import json
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report.result import DriveResult
from lcd_loop_closure.report.run_drive import main


class _Nodes:
    """Stands in for nodes.offline_slam: remembers what it was asked for and returns a result."""

    def __init__(self, result: DriveResult) -> None:
        self.result = result
        self.asked: dict[str, Any] = {}

    def drive_through(self, drive: Any, **asked: Any) -> DriveResult:
        self.asked = {'drive': drive, **asked}
        return replace(self.result, name=drive.name, source=asked['source'])


@pytest.fixture
def nodes(result: DriveResult, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> _Nodes:
    nodes = _Nodes(result)
    module = ModuleType('lcd_loop_closure.nodes.offline_slam')
    module.drive_through = nodes.drive_through  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    monkeypatch.chdir(tmp_path)
    return nodes


def test_without_arguments_a_town_is_driven(
    nodes: _Nodes, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['--no-plots']) == 0
    assert nodes.asked['drive'].name == 'town_36_run0'
    out = capsys.readouterr().out
    assert 'results/town_36_run0/report.html' in out
    assert '20 true, 2 false' in out and 'ATE' in out and 'truncated velodyne file' in out
    assert Path('results/town_36_run0/report.html').is_file()


def test_options_reach_the_nodes(nodes: _Nodes, tmp_path: Path) -> None:
    (tmp_path / 'a.yaml').write_text('pose_graph: {ros__parameters: {}}')
    options = [
        '--start',
        '5',
        '--duration',
        '10',
        '--threads',
        '1',
        '--params',
        'a.yaml',
        '--quiet',
    ]
    assert main(['street:abrupt_u_turn', '--out', 'out', '--picture', 'docs/x.png', *options]) == 0
    asked = nodes.asked
    assert asked['drive'].name == 'street_abrupt_u_turn'
    assert (asked['start_s'], asked['duration_s'], asked['threads']) == (5.0, 10.0, 1)
    assert asked['parameter_files'] == [Path('a.yaml')] and asked['progress'] is False
    assert Path('docs/x.png').read_bytes() == Path('out/plots/overview.png').read_bytes()


def test_earlier_results_are_kept_unless_asked(
    nodes: _Nodes, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(['--out', 'out', '--no-plots']) == 0
    nodes.asked = {}
    assert main(['--out', 'out', '--no-plots']) == 1
    assert '--overwrite' in capsys.readouterr().err
    assert not nodes.asked  # said before the drive, not after
    assert main(['--out', 'out', '--no-plots', '--overwrite']) == 0


def test_a_reference_from_a_file_is_used(nodes: _Nodes, truth: Trajectory) -> None:
    moved = truth.T_world_body.copy()
    moved[:, 2, 3] += 0.1 * np.sin(np.arange(len(truth)))
    Trajectory(truth.stamps_ns, moved).write_tum(Path('other.tum'))
    assert main(['--out', 'a', '--no-plots']) == 0
    assert main(['--out', 'b', '--no-plots', '--truth', 'other.tum']) == 0
    errors = [
        json.loads(Path(name, 'metrics.json').read_text())['after']['ate_rmse_m'] for name in 'ab'
    ]
    assert errors[1] == pytest.approx(np.hypot(errors[0], 0.1 / np.sqrt(2)), rel=0.05)


def test_an_interrupted_drive_is_reported_and_told(
    nodes: _Nodes, capsys: pytest.CaptureFixture[str]
) -> None:
    nodes.result = replace(nodes.result, interrupted=True)
    assert main(['--out', 'out', '--no-plots']) == 130
    assert 'Interrupted' in capsys.readouterr().out
    assert json.loads(Path('out/metrics.json').read_text())['drive']['interrupted'] is True


def test_a_drive_without_odometry_says_why(
    nodes: _Nodes, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = Trajectory(np.empty(0, np.int64), np.empty((0, 4, 4)))
    counts = {'/lidar_odometry': {'rejected points: no transform': 801}}
    nodes.result = replace(nodes.result, odometry=empty, keyframes=empty, counts=counts)
    assert main(['--out', 'out']) == 1
    error = capsys.readouterr().err
    assert 'none of 801 scans' in error and 'no transform (801)' in error
    assert not Path('out').exists()


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['missing.mcap'], 'missing.mcap'),
        (['street:nowhere'], 'nowhere'),
        (['--start', '1e6'], 'start'),
        (['--params', 'missing.yaml'], 'missing.yaml'),
        (['--truth', 'missing.tum'], 'missing.tum'),
        (['--truth', 'note.txt'], 'note.txt'),
        (['--truth', 'note.txt', '--truth-frame', 'roof'], 'roof'),
        (['--out', 'note.txt'], 'is a file'),
        (['--out', '.'], 'other things'),
        (['--topic', 'points:=/velodyne'], 'recording'),
        (['.', '--topic', 'points=/velodyne'], 'points:=/velodyne'),
        (['.'], 'no known drive'),
    ],
)
def test_mistakes_are_one_line_before_the_drive(
    nodes: _Nodes, options: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    Path('note.txt').write_text('dear diary')
    assert main(options) == 1
    error = capsys.readouterr().err
    assert message in error and error.startswith('error: ') and error.count('\n') == 1
    assert not nodes.asked


@pytest.mark.parametrize('option', [['--threads', '-1'], ['--start', '-3'], ['--duration', 'x']])
def test_impossible_options_are_refused(option: list[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(option)
    assert stop.value.code == 2


def test_help_shows_examples(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(['--help'])
    assert 'run_drive drive.mcap --truth truth.tum' in capsys.readouterr().out
