"""The README's tables come from the result files alone."""

import json
from pathlib import Path

import pytest

from benchmarks import tables

README = 'Results\n\n<!-- table:drive -->\nold\n<!-- end -->\nafter\n'


@pytest.fixture
def results(tmp_path: Path) -> Path:
    figures = {
        'measured': {'commit': 'abc123', 'date': '2026-01-02', 'machine': 'two cores'},
        'out_and_back': {
            'odometry_latency_p50_ms': 41.6,
            'odometry_latency_p99_ms': 120,
            'loops_found_share': 0.876,
        },
        'kitti_08': {'loops': 334, 'pairs': 2960},
        'memory': {'bytes_per_keyframe': 12345},
    }
    (tmp_path / 'drive.json').write_text(json.dumps(figures))
    return tmp_path


def test_values_come_in_their_units_and_gaps_are_named(results: Path) -> None:
    text = tables.rewritten(README, results)
    assert '| 42 / 120 ms | ≤ 70 / 200 ms |' in text
    assert '| 88 % | ≥ 80 % |' in text
    assert '| 334 / 2960 | 334 / 2960 |' in text
    assert '| 12.3 kB |' in text
    assert '| not measured | ≤ 0.2 m |' in text
    assert 'commit `abc123` on 2026-01-02: two cores' in text
    assert text.startswith('Results\n') and text.endswith('<!-- end -->\nafter\n')
    assert 'old' not in text


def test_rewriting_twice_changes_nothing(results: Path) -> None:
    once = tables.rewritten(README, results)
    assert tables.rewritten(once, results) == once


def test_check_tells_without_touching(
    results: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    readme = tmp_path / 'README.md'
    readme.write_text(README)
    options = ['--readme', str(readme), '--results', str(results)]
    assert tables.main([*options, '--check']) == 1
    assert readme.read_text() == README
    assert tables.main(options) == 0
    assert tables.main([*options, '--check']) == 0
    assert 'up to date' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('readme', 'result', 'message'),
    [
        ('no table here', '{}', 'found none'),
        ('<!-- table:nonsense -->\n<!-- end -->', '{}', 'unknown'),
        (README, '{"cut": ', 'expected JSON'),
        (README, '[1]', 'expected nested keys'),
        (README, None, 'No such file'),
    ],
)
def test_mistakes_are_one_line(
    tmp_path: Path,
    readme: str,
    result: str | None,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / 'README.md').write_text(readme)
    if result is not None:
        (tmp_path / 'drive.json').write_text(result)
    code = tables.main(['--readme', str(tmp_path / 'README.md'), '--results', str(tmp_path)])
    error = capsys.readouterr().err
    assert code == 1 and message in error and error.count('\n') == 1


def test_every_key_that_the_issue_names_is_shown() -> None:
    keys = {key for row in tables.TABLES['drive'] for key in row.keys}
    assert {
        'out_and_back.odometry_lost',
        'out_and_back.end_error_m',
        'kitti_00.negatives_rejected',
        'false_loops.wrong_accepted',
        'u_turn.kiss_slam_ate_m',
        'graph_update_p99_ms_at_10000',
        'memory.bytes_per_keyframe',
    } <= keys
