"""A benchmark command fails where a figure is missing, and keeps those it did not measure."""

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import drive, report
from benchmarks.command import Benchmark, Section, run_benchmark
from lcd_common.errors import DataError


def _fails(work: Path) -> dict[str, Any]:
    raise DataError('no recording here')


@pytest.fixture
def results(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(report, 'RESULTS', tmp_path / 'results')
    return tmp_path / 'results' / 'drive.json'


def _run(arguments: list[str], required: tuple[str, ...], **sections: Section) -> int:
    """Run the drive benchmark with sections of these names in the place of its own."""
    benchmark = Benchmark(
        'drive',
        'a test',
        lambda quick: {name: (name, section) for name, section in sections.items()},
        required,
        drive._placed,
    )
    return run_benchmark(benchmark, arguments)


def test_all_figures_there_is_success(results: Path) -> None:
    required = ('kitti_08.loops', 'peers.kiss_slam.*')
    peers = {'kiss_slam': {'street': {'ate_m': 1.5}}}
    assert _run([], required, kitti_08=lambda w: {'loops': 3}, peers=lambda w: peers) == 0
    figures = json.loads(results.read_text())
    assert figures['kitti_08'] == {'loops': 3}
    assert figures['peers'] == peers
    assert set(figures['measured']) == {'kitti_08', 'peers'}
    assert figures['measured']['peers']['quick'] is False


def test_a_failed_section_is_a_failure_though_no_figure_is_missing(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    required = ('kitti_08.loops',)
    assert _run([], required, kitti_08=lambda w: {'loops': 3}) == 0
    before = json.loads(results.read_text())
    assert _run([], required, kitti_08=_fails) == 1
    assert 'could not run kitti_08: DataError: no recording here' in capsys.readouterr().err
    assert json.loads(results.read_text()) == before


def test_sections_after_a_failed_one_are_measured(results: Path) -> None:
    assert _run([], (), kitti_08=_fails, memory=lambda w: {'keyframes': 7}) == 1
    assert json.loads(results.read_text())['memory'] == {'keyframes': 7}


@pytest.mark.parametrize('missing', ['kitti_08.pairs', 'peers.kiss_slam.*', 'memory.absent'])
def test_a_missing_figure_is_a_failure(
    results: Path, capsys: pytest.CaptureFixture[str], missing: str
) -> None:
    sections: dict[str, Section] = {
        'kitti_08': lambda w: {'loops': 3},
        'memory': lambda w: {'absent': None},
    }
    assert _run([], ('kitti_08.loops', missing), **sections) == 1
    assert f'missing figures: {missing}\n' in capsys.readouterr().err


def test_an_unknown_section_measures_nothing(
    results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run(['--only', 'kiti'], (), kitti_08=lambda w: {'loops': 3}) == 1
    assert 'no section kiti; there are kitti_08' in capsys.readouterr().err
    assert not results.exists()


def test_sections_that_did_not_run_keep_their_figures(results: Path) -> None:
    first: dict[str, Section] = {
        'u_turn': lambda w: {'ate_m': 0.5, 'broken': {'ate_m': 0.25}},
        'out_and_back': lambda w: {'loops_wrong': 0, 'gone': 1},
        'lockstep': lambda w: {'lockstep_realtime_factor': 2.5},
        'graph_update': lambda w: {'p99_ms': 40.0, 'keyframes': 10_000},
    }
    assert _run([], (), **first) == 0
    second = dict.fromkeys(first, _fails) | {'out_and_back': lambda w: {'loops_wrong': 1}}
    assert _run(['--quick', '--only', 'out_and_back'], (), **second) == 0
    figures = json.loads(results.read_text())
    assert figures['u_turn'] == {'ate_m': 0.5, 'broken': {'ate_m': 0.25}}
    assert figures['graph_update_p99_ms_at_10000'] == figures['graph_update']['p99_ms'] == 40.0
    # The section's own figures are replaced as a whole; those of the lock-step beside them stay.
    assert figures['out_and_back'] == {'loops_wrong': 1, 'lockstep_realtime_factor': 2.5}
    quick = {name: entry['quick'] for name, entry in figures['measured'].items()}
    assert quick == {
        'u_turn': False,
        'out_and_back': True,
        'lockstep': False,
        'graph_update': False,
    }


def test_lockstep_and_live_may_be_measured_in_either_order(results: Path) -> None:
    live, lockstep = {'loops_wrong': 0}, {'lockstep_end_error_m': 0.5}
    either = [
        drive._placed(drive._placed({}, 'lockstep', lockstep), 'out_and_back', live),
        drive._placed(drive._placed({}, 'out_and_back', live), 'lockstep', lockstep),
    ]
    assert either == [{'out_and_back': {**live, **lockstep}}] * 2


def test_placing_leaves_the_figures_before_as_they_were(results: Path) -> None:
    before = {'out_and_back': {'loops_wrong': 0}}
    drive._placed(before, 'lockstep', {'lockstep_end_error_m': 0.5})
    assert before == {'out_and_back': {'loops_wrong': 0}}


def test_every_required_figure_has_a_section_of_its_name() -> None:
    names = set(drive.sections()) | {'graph_update_p99_ms_at_10000'}
    assert {key.split('.')[0] for key in drive.REQUIRED} <= names
