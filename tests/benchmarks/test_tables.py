"""The READMEs' tables come from the result files alone."""

import json
from pathlib import Path

import pytest

from benchmarks import lcdnet_ablations, tables

README = 'Results\n\n<!-- table:drive -->\nold\n<!-- end -->\nafter\n'


@pytest.fixture
def results(tmp_path: Path) -> Path:
    figures = {
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
    assert '| 12 kB |' in text
    assert '| not measured | ≤ 0.2 m |' in text
    assert text.startswith('Results\n') and text.endswith('<!-- end -->\nafter\n')
    assert 'old' not in text


def test_the_committed_readmes_show_what_the_results_say(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert tables.main(['--check']) == 0, capsys.readouterr().out
    texts = ''.join(readme.read_text() for readme in tables.READMES)
    assert all(f'<!-- table:{name} -->' in texts for name in tables.TABLES)


def _lines(name: str, figures: dict[str, object]) -> list[list[str]]:
    lines = tables.TABLES[name].markdown(figures).splitlines()
    rows = [line for line in lines if line.startswith('| ')]
    return [[cell.strip() for cell in row.split('|')[1:-1]] for row in rows]


def test_real_stands_beside_simulated() -> None:
    kitti = {
        'points': {'real': 122543.0, 'simulated': 116954.0},
        'ground_share': {'real': 0.4298, 'simulated': 0.646},
        'range_histogram_distance': 0.1056,
    }
    figures = {
        'real_vs_sim': {
            'kitti_00': kitti,
            'real_against_real': {'range_histogram_distance': 0.1182},
        },
        'measured': {
            'realism': {'commit': 'abc123', 'date': '2026-01-02', 'machine': 'two', 'quick': True}
        },
    }
    header, *rows = _lines('realism', figures)
    assert header[1:4] == ['KITTI 00', 'KITTI-360', 'Karlsruhe']
    assert {len(row) for row in rows} == {len(header)}
    by_name = {row[0]: row[1:] for row in rows}
    unknown = 'not measured'
    assert by_name['Points of a sweep'] == ['122,543 / 116,954', unknown, unknown, '']
    assert by_name['Points on the ground'][0] == '43 / 65 %'
    assert by_name['Histograms of range, distance'] == ['0.11', unknown, unknown, '0.12']
    assert by_name['Histograms of intensity, distance'][2] == 'has none'
    text = tables.TABLES['realism'].markdown(figures)
    assert text.endswith('\n\nMeasured with --quick at commit `abc123` on 2026-01-02: two.\n')


def test_difficulty_is_the_mean_over_the_towns() -> None:
    def places(within: float, aliased: float) -> dict[str, float]:
        return {
            'distance_within_a_place': within,
            'distance_to_most_similar_other_place': 0.25,
            'distance_between_places': 0.4,
            'aliased_share': aliased,
        }

    by_town = {'town_200': places(0.1, 0.05), 'town_201': places(0.2, 0.15)}
    figures = {
        'scan_context_ap': {
            'same_way': 0.9512,
            'same_way_by_town': by_town,
            'reverse': 0.7,
            'reverse_by_town': {'town_200': places(0.1, 0.05), 'town_201': {}},
            'aliased_same_way': 0.8,
            'aliased_same_way_by_town': {'town_209': places(0.2, 0.3)},
        }
    }
    _, same_way, reverse, aliased, *_ = _lines('difficulty', figures)
    assert same_way == ['Same way', '0.951', '0.15', '0.25', '0.40', '10 %']
    assert reverse == ['In reverse', '0.700', *['not measured'] * 4]
    assert aliased[1:] == ['0.800', '0.20', '0.25', '0.40', '30 %']
    assert {cell for row in _lines('difficulty', {})[1:] for cell in row[1:]} == {'not measured'}


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
    keys = {key for row in tables.TABLES['drive'].rows for key in row.keys}
    assert {
        'out_and_back.odometry_lost',
        'out_and_back.end_error_m',
        'kitti_00.negatives_rejected',
        'false_loops.wrong_accepted',
        'u_turn.kiss_slam_ate_m',
        'graph_update_p99_ms_at_10000',
        'memory.bytes_per_keyframe',
    } <= keys


def test_every_variant_that_is_trained_has_its_row() -> None:
    rows = tables.TABLES['lcdnet_ablations'].rows
    trained = {f'ablations.{name}.average_precision' for name in lcdnet_ablations.VARIANTS}
    assert {row.cells[0].keys[0] for row in rows} == trained
