"""Pairs by distance, against brute force."""

import numpy as np
import pytest
from small_runs import small_run

from lcd_common.errors import DataError
from uncertain_place_recognition.runs import SubmapRun
from uncertain_place_recognition.training.pairs import PairConfig, PlacePairs


def _moved(run):
    """Runs of one world begin at one moment; to the side, so that none is a copy."""
    moved = run.T_world_base.copy()
    moved[:, 1, 3] = 1.5
    return SubmapRun(run.name, run.world, run.stamps_ns, moved, run.points)


RUNS = [
    small_run('a', 'w', count=30),
    _moved(small_run('b', 'w', count=25)),
    small_run('c', 'other', count=20),
]


def _same_place(pairs, i, j, radius):
    one, other = RUNS[pairs.run[i]], RUNS[pairs.run[j]]
    if one.world != other.world or i == j:
        return None
    return np.linalg.norm(one.positions[pairs.at[i]] - other.positions[pairs.at[j]]) <= radius


def test_positives_and_relations_are_those_of_brute_force():
    pairs = PlacePairs(RUNS, PairConfig(positive=10.0, negative=50.0))
    assert len(pairs) == 75
    chosen = np.arange(75)
    relations = pairs.relations(chosen)
    for i in range(75):
        expected = [j for j in range(75) if _same_place(pairs, i, j, 10.0)]
        assert pairs.positives(i).tolist() == expected
        assert np.flatnonzero(relations.positive[i]).tolist() == expected
        for j in range(75):
            near = _same_place(pairs, i, j, 50.0)
            other_world = RUNS[pairs.run[i]].world != RUNS[pairs.run[j]].world
            assert relations.negative[i, j] == (other_world or (i != j and not near))
    assert not (relations.positive & relations.negative).any()


def test_drawn_pairs_are_positives_mostly_of_another_pass():
    pairs = PlacePairs(RUNS, PairConfig(positive=6.0, other_pass=1.0))
    drawn = pairs.draw(200, np.random.default_rng(0)).reshape(-1, 2)
    for anchor, positive in drawn:
        assert positive in pairs.positives(anchor)
        if RUNS[pairs.run[anchor]].name in 'ab' and pairs.at[anchor] < 25:
            assert pairs.run[positive] != pairs.run[anchor]
    assert len({tuple(pair) for pair in drawn}) > 100
    again = pairs.draw(200, np.random.default_rng(0)).reshape(-1, 2)
    np.testing.assert_array_equal(drawn, again)


def test_the_same_moment_is_no_pair():
    run = RUNS[0]
    copy = SubmapRun('copy', 'w', run.stamps_ns, run.T_world_base, run.points)
    pairs = PlacePairs([run, copy], PairConfig(positive=5.0, negative=50.0))  # spacing is 4 m
    assert pairs.positives(10).tolist() == [9, 11, 39, 41]
    assert not pairs.relations(np.array([10, 40])).positive.any()


def test_settings_and_runs_without_pairs_are_refused():
    with pytest.raises(DataError, match='farther away than positives'):
        PlacePairs(RUNS, PairConfig(positive=10.0, negative=5.0))
    with pytest.raises(DataError, match='raise the radius'):
        PlacePairs([RUNS[2]], PairConfig(positive=1.0))
