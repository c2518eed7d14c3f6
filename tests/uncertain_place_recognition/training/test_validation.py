"""Recall and interchange of validation runs against brute force."""

import numpy as np
import pytest
from small_runs import small_run

from lcd_common.errors import DataError
from uncertain_place_recognition.training.validation import interchange, recall

RUNS = [small_run('a', 'w', count=40), small_run('b', 'w', count=20), small_run('c', 'x', count=9)]


def _embeddings(seed):
    rng = np.random.default_rng(seed)
    return [rng.normal(size=(len(run), 4)).astype(np.float32) for run in RUNS]


def test_recall_is_that_of_brute_force():
    database, queries = _embeddings(0), _embeddings(1)
    shares, chances, total = [], [], 0
    for k, run in enumerate(RUNS):
        right, asked, lucky = 0, 0, []
        for i in range(len(run)):
            options = []
            for m, other in enumerate(RUNS):
                for j in range(len(other)):
                    if m == k and abs(int(other.stamps_ns[j] - run.stamps_ns[i])) < 30e9:
                        continue
                    away = np.linalg.norm(run.positions[i] - other.positions[j])
                    true = other.world == run.world and away <= 25.0
                    distance = np.linalg.norm(queries[k][i] - database[m][j])
                    options.append((distance, true))
            if any(true for _, true in options):
                asked += 1
                right += min(options)[1]
                lucky.append(np.mean([true for _, true in options]))
        if asked:
            shares.append(right / asked)
            chances.append(np.mean(lucky))
            total += asked
    found = recall(RUNS, database, queries)
    assert found.recall_1 == pytest.approx(np.mean(shares))
    assert found.chance == pytest.approx(np.mean(chances))
    assert found.queries == total and len(shares) == 2


def test_members_that_agree_understand_one_another_and_strangers_do_not():
    rng = np.random.default_rng(0)
    place = {}
    runs = [small_run(name, 'w', count=60, spacing_m=10.0) for name in 'ab']

    def embed(turn):
        return [
            np.array([
                place.setdefault((run.world, k), rng.normal(size=16)) @ turn
                for k in range(len(run))
            ], np.float32)
            for run in runs
        ]  # fmt: skip

    turns = [np.eye(16), np.linalg.qr(rng.normal(size=(16, 16)))[0]]
    strangers = interchange(runs, [embed(turn) for turn in turns])
    alike = interchange(runs, [embed(np.eye(16)), embed(np.eye(16))])
    assert strangers.diagonal == alike.diagonal == alike.off_diagonal == 1.0
    assert strangers.off_diagonal < 3 * strangers.chance
    assert alike.diversity == 0.0 and strangers.diversity > 0.5


def test_runs_without_a_true_match_are_refused():
    with pytest.raises(DataError, match='two runs of each world'):
        recall([RUNS[2]], _embeddings(0)[2:], _embeddings(0)[2:])
