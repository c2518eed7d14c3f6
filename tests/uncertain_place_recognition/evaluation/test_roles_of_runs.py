"""Databases that do not ask, queries that are not searched, and queries that are some of a run."""

import json
from dataclasses import replace

import numpy as np
import pytest
from made_runs import made_run

from lcd_common.errors import DataError
from uncertain_place_recognition import calibrate, evaluate
from uncertain_place_recognition.ambiguity import AmbiguityConfig, match_spread
from uncertain_place_recognition.embedded_run import EmbeddedRun, ordered_pairs
from uncertain_place_recognition.evaluation.interchange import interchange
from uncertain_place_recognition.evaluation.pairs import METHODS, PairConfig, judge_pair
from uncertain_place_recognition.evaluation.study import study
from uncertain_place_recognition.trust import Calibration


def nobody(run):
    return np.zeros(len(run), bool)


@pytest.fixture(scope='module')
def runs():
    return [made_run(name, submaps=n, noise=0.3) for name, n in (('a', 60), ('b', 30), ('c', 40))]


def test_a_database_does_not_ask_and_queries_are_not_searched(runs):
    database, queries, both = runs
    database = replace(database, asking=nobody(database))
    queries = replace(queries, searched=False)
    assert ordered_pairs([database, queries]) == [(0, 1)]
    assert ordered_pairs([database, queries, both]) == [(0, 1), (0, 2), (2, 1)]
    with pytest.raises(DataError, match='no run with queries has a database of its world'):
        ordered_pairs([database, replace(both, asking=nobody(both))])
    with pytest.raises(DataError, match='databases: none; queries: b in town, c in town'):
        ordered_pairs([queries, replace(both, searched=False)])
    with pytest.raises(DataError, match='expected 60 flags of queries'):
        replace(runs[0], asking=np.ones(3, bool))


@pytest.mark.parametrize('method', METHODS)
def test_some_queries_are_judged_as_among_all(runs, method):
    chosen = np.random.default_rng(0).random(30) < 0.4
    masked = np.random.default_rng(1).random(30) < 0.5
    whole = judge_pair(runs, (0, 1), method, PairConfig(), masked)
    some = [runs[0], replace(runs[1], asking=chosen)]
    part = judge_pair(some, (0, 1), method, PairConfig(), masked)
    assert part.size == whole.size == 60
    np.testing.assert_array_equal(part.known, whole.known[chosen])
    np.testing.assert_array_equal(part.right, whole.right[chosen])
    for name, doubt in part.ranking.doubt.items():
        np.testing.assert_allclose(doubt, whole.ranking.doubt[name][chosen], rtol=1e-4, atol=1e-6)


def test_members_are_exchanged_for_these_queries_alone(runs):
    chosen = np.arange(30) < 10
    tenth = EmbeddedRun(
        'b', 'town', runs[1].stamps_ns[:10], runs[1].positions[:10],
        {'students': runs[1].of('students')[:10]},
    )  # fmt: skip
    database = replace(runs[0], asking=nobody(runs[0]))
    asked = interchange([database, replace(runs[1], asking=chosen, searched=False)], 'students')
    alone = interchange([database, replace(tenth, searched=False)], 'students')
    np.testing.assert_array_equal(asked.recall, alone.recall)
    assert asked.chance == alone.chance


def test_the_command_searches_one_way_where_it_is_told_so(tmp_path, capsys):
    for name in 'ab':
        made_run(name, submaps=40, noise=0.3).save(tmp_path / f'{name}.npz')
    a, b = (str(tmp_path / f'{name}.npz') for name in 'ab')
    out = ['--out', str(tmp_path / 'out'), '--quiet']
    assert evaluate.main(['--database', a, '--queries', b, *out]) == 0
    one_way = json.loads((tmp_path / 'out' / 'results.json').read_text())
    assert one_way['pairs'] == 1 and one_way['recall']['shared']['pairs'] == 1
    assert evaluate.main([a, b, *out]) == 0
    both = json.loads((tmp_path / 'out' / 'results.json').read_text())
    assert both['pairs'] == 2
    assert one_way['recall']['shared']['queries'] < both['recall']['shared']['queries']
    assert evaluate.main(['--database', a, *out]) == 1
    assert 'name runs, or runs for --database and for --queries' in capsys.readouterr().err


def test_ambiguity_is_measured_as_the_settings_say(runs, tmp_path, capsys):
    few = AmbiguityConfig(matches=2)
    usual = study(runs).scores['shared_ambiguity'].figures
    found = study(runs, ambiguity=few)
    assert found.scores['shared_ambiguity'].figures != usual
    assert found.facts['ambiguity']['matches'] == 2
    where = np.array([[[0.0, 0.0], [9.0, 0.0], [90.0, 0.0]]])
    assert match_spread(np.ones((1, 3)), where, few) < match_spread(np.ones((1, 3)), where)
    for name in 'abc':
        run = made_run(name, submaps=50, noise=0.3)
        replace(run, facts={'weights': {'students': 'h'}}).save(tmp_path / 'in' / f'{name}.npz')
    given = [str(tmp_path / 'in'), '--quiet', '--out', str(tmp_path / 'out')]
    for command in (evaluate, calibrate):
        assert command.main([*given, '--ambiguity', 'matches=3', 'sharpness=5']) == 0
        figures = json.loads((tmp_path / 'out' / 'results.json').read_text())
        assert (figures['ambiguity']['matches'], figures['ambiguity']['sharpness']) == (3, 5.0)
        assert command.main([*given, '--ambiguity', 'metches=3']) == 1
        assert "'metches=3' is no setting" in capsys.readouterr().err


def test_a_calibration_keeps_its_ambiguity_and_spacing_for_the_node(tmp_path):
    for name in 'abc':
        run = made_run(name, submaps=50, noise=0.3)
        replace(run, facts={'weights': {'students': 'h'}}).save(tmp_path / 'in' / f'{name}.npz')
    given = [str(tmp_path / 'in'), '--quiet', '--out', str(tmp_path / 'out')]
    assert calibrate.main([*given, '--ambiguity', 'matches=5']) == 0
    made = Calibration.load(tmp_path / 'out' / 'calibration.json')
    assert made.ambiguity.matches == 5
    step = np.linalg.norm(np.diff(run.positions, axis=0), axis=1)
    assert made.spacing_m == pytest.approx(float(np.median(step)), rel=0.2)
