"""The benchmark's rules, against a plain loop; intervals over runs; interchange of members."""

import numpy as np
import pytest
from made_runs import made_run

from lcd_common.errors import DataError
from uncertain_place_recognition.embedded_run import EmbeddedRun, is_embedded, ordered_pairs
from uncertain_place_recognition.evaluation.bootstrap import drawn_pairs, mean_interval
from uncertain_place_recognition.evaluation.interchange import interchange
from uncertain_place_recognition.evaluation.pairs import (
    METHODS,
    PairConfig,
    available,
    judge_pair,
    judge_pairs,
)
from uncertain_place_recognition.evaluation.recall import recall


@pytest.fixture(scope='module')
def runs():
    town = [made_run(name, submaps=n) for name, n in (('a', 60), ('b', 25), ('c', 130))]
    # Of another length, and 200 m longer than the others: some queries have no true match.
    longer = made_run('d', submaps=70)
    far = EmbeddedRun(
        'd', 'town', longer.stamps_ns, longer.positions + np.array([200.0, 0.0]), longer.members
    )
    return [*town, far, made_run('x', world='elsewhere'), made_run('y', world='elsewhere')]


def by_loop(runs, radius=25.0):
    """Recall of the first student by cosine, as the benchmark's script goes about it."""
    values = {1: [], 5: [], 10: [], '1%': []}
    for m, database in enumerate(runs):
        for n, queries in enumerate(runs):
            if m == n or database.world != queries.world:
                continue
            hits = {key: [] for key in values}
            for q in range(len(queries)):
                apart = np.linalg.norm(database.positions - queries.positions[q], axis=1)
                if not (apart <= radius).any():
                    continue
                query = queries.members['students'][q, 0]
                rows = database.members['students'][:, 0]
                cosine = rows @ query / np.linalg.norm(rows, axis=1) / np.linalg.norm(query)
                order = np.argsort(-cosine, kind='stable')
                for key in values:
                    top = max(round(len(database) / 100), 1) if key == '1%' else key
                    hits[key].append((apart[order[:top]] <= radius).any())
            for key, found in hits.items():
                if found:
                    values[key].append(np.mean(found))
    return {key: np.mean(found) for key, found in values.items()}


def test_recall_is_that_of_a_plain_loop(runs):
    expected = by_loop(runs)
    found = recall(judge_pairs(runs, 'student'))
    assert found.at == pytest.approx({n: expected[n] for n in (1, 5, 10)})
    assert found.one_percent == pytest.approx(expected['1%'])
    assert found.pairs == 4 * 3 + 2
    assert 0.0 < found.at[1] < found.at[10] <= 1.0


def test_pooling_all_queries_would_give_another_number(runs):
    judged = judge_pairs(runs, 'student')
    pooled = np.concatenate([pair.hit(1)[pair.known] for pair in judged]).mean()
    assert abs(recall(judged).at[1] - pooled) > 1e-3


def test_one_percent_is_at_least_one_and_may_be_more_than_the_matches_kept(runs):
    pair = judge_pair(runs, (2, 0), 'student', PairConfig(matches=1))
    assert pair.one_percent == 1 and pair.right.shape[1] == 1
    large = made_run('large', submaps=420)
    pair = judge_pair([large, runs[0]], (0, 1), 'student', PairConfig(matches=2))
    assert pair.one_percent == 4 == pair.right.shape[1]


def test_every_method_has_its_doubt(runs):
    assert available(runs) == list(METHODS)
    for name, (_, _, doubt) in METHODS.items():
        judged = judge_pairs(runs[:2], name)
        assert all(len(pair.ranking.doubt[doubt]) == len(pair.right) for pair in judged)


def test_methods_without_embeddings_are_left_out(runs):
    bare = EmbeddedRun(
        'bare', 'town', runs[0].stamps_ns, runs[0].positions, {'stun': runs[0].of('stun')}
    )
    assert available([bare, runs[1]]) == []
    with pytest.raises(DataError, match="no embeddings 'naive'; it has stun"):
        judge_pairs([bare, runs[0]], 'mason')


def test_masked_queries_have_no_right_answer(runs):
    masked = np.zeros(len(runs[1]), bool)
    masked[::2] = True
    free = judge_pair(runs, (0, 1), 'shared', PairConfig())
    pair = judge_pair(runs, (0, 1), 'shared', PairConfig(), masked)
    assert not pair.right[masked].any() and not pair.known[masked].any()
    away = np.linalg.norm(pair.where - runs[1].positions[:, None], axis=-1)
    assert away[masked].min() > 50.0
    assert np.array_equal(pair.ranking.entry[~masked], free.ranking.entry[~masked])


def test_runs_of_different_worlds_are_not_searched_in_one_another(runs):
    assert len(ordered_pairs(runs)) == 14
    with pytest.raises(DataError, match='no two runs are of one world'):
        ordered_pairs([runs[0], runs[4]])
    far = EmbeddedRun('far', 'town', runs[0].stamps_ns, runs[0].positions + 1e5, runs[0].members)
    assert recall(judge_pairs([runs[0], far], 'student')) is None


def test_the_interval_over_runs_is_wider_than_that_over_queries():
    # Ten runs which differ a lot; every query of a run has the run's value.
    rng = np.random.default_rng(0)
    level = rng.normal(size=10)
    pairs = [(m, n) for m in range(10) for n in range(10) if m != n]
    values = np.array([level[n] for _, n in pairs])
    low, high = mean_interval(pairs, values)
    # The mean of ten: half width 1.96 s / sqrt(10), over 90 "independent" pairs a third of it.
    expected = 1.96 * level.std() / np.sqrt(10)
    assert (high - low) / 2 == pytest.approx(expected, rel=0.3)
    assert low < values.mean() < high


def test_two_runs_say_nothing_about_runs():
    assert list(drawn_pairs([(0, 1), (1, 0)])) == []
    assert mean_interval([(0, 1), (1, 0)], np.ones(2)) is None
    assert mean_interval([(0, 1), (1, 2), (2, 0)], np.full(3, np.nan)) is None


def test_a_pair_is_drawn_as_often_as_both_its_runs():
    pairs = [(0, 1), (1, 2), (2, 0), (1, 0)]
    counts = np.array([np.bincount(c, minlength=4) for c in drawn_pairs(pairs, 4000)])
    assert np.array_equal(counts[:, 0], counts[:, 3])
    # Of three draws, one each of two given runs and one of any: E[x y] = 3 * 2 / 9.
    share = len(counts) / 4000
    assert counts.mean(0) * share == pytest.approx(6 / 9, abs=0.05)


def test_members_of_one_space_can_be_exchanged_and_others_cannot(runs):
    town = runs[:3]
    shared, apart = interchange(town, 'students'), interchange(town, 'naive')
    assert shared.off_diagonal > shared.diagonal - 0.1
    assert apart.diagonal == pytest.approx(shared.diagonal, abs=0.1)
    assert apart.off_diagonal < 3.0 * apart.chance + 0.05
    single = interchange(town, 'teacher')
    assert single.off_diagonal is None
    assert single.diagonal == pytest.approx(recall(judge_pairs(town, 'teacher')).at[1])


def test_chance_is_the_share_of_right_entries(runs):
    chances = []
    for m, n in ordered_pairs(runs[:2]):
        apart = np.linalg.norm(runs[m].positions[None] - runs[n].positions[:, None], axis=2)
        right = (apart <= 25.0).mean(1)
        chances.append(right[right > 0].mean())
    assert interchange(runs[:2], 'students').chance == pytest.approx(np.mean(chances))


def test_an_embedded_run_survives_its_file(runs, tmp_path):
    path = tmp_path / 'runs' / 'a.npz'
    runs[0].save(path)
    loaded = EmbeddedRun.load(path)
    assert (loaded.name, loaded.world) == ('a', 'town')
    assert loaded.members.keys() == runs[0].members.keys()
    assert np.array_equal(loaded.of('naive'), runs[0].of('naive'))
    assert is_embedded(path)
    path.write_text('no run')
    assert not is_embedded(path)
    with pytest.raises(DataError, match='no embedded run'):
        EmbeddedRun.load(path)


def test_shapes_that_do_not_fit_are_named(runs):
    with pytest.raises(DataError, match='expected 60 positions'):
        EmbeddedRun('a', 'town', runs[0].stamps_ns, runs[0].positions[:3], {})
    with pytest.raises(DataError, match='expected 60 x members'):
        EmbeddedRun('a', 'town', runs[0].stamps_ns, runs[0].positions, {'x': np.ones((60, 4))})
