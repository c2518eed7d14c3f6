"""The compact search against comparing everything in double precision."""

import numpy as np
import pytest
import torch

from lcd_common.errors import DataError
from lcd_loop_closure import compact_search
from lcd_loop_closure.compact_search import CompactSearch


def units(number: int, length: int = 64, *, alike: float = 0.0, seed: int = 0) -> np.ndarray:
    """Return unit vectors, the more of one direction the more alike."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(number, length)) + alike * rng.normal(size=length)
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


def exact(rows: np.ndarray, query: np.ndarray, count: int) -> np.ndarray:
    return np.argsort(
        np.linalg.norm(rows.astype(float) - query.astype(float), axis=1), kind='stable'
    )[:count]


@pytest.mark.parametrize('kernel', [True, False])
@pytest.mark.parametrize('alike', [0.0, 3.0, 30.0])
def test_the_answer_is_that_of_comparing_everything(monkeypatch, kernel, alike):
    if not kernel:
        monkeypatch.setattr(compact_search, '_has_kernel', lambda: False)
    rows = units(9001, 256, alike=alike)
    search = CompactSearch(256)
    for part in np.array_split(rows, 7):
        search.add(part)
    assert len(search) == 9001
    for query in units(40, 256, alike=alike, seed=1):
        numbers, distances = search.nearest(query, 10)
        expected = exact(rows, query, 10)
        assert set(numbers) == set(expected)
        assert distances == pytest.approx(np.linalg.norm(rows[expected] - query, axis=1), abs=1e-6)


def test_a_vector_finds_itself_first_and_equal_ones_in_order():
    rows = units(500)
    search = CompactSearch(64, capacity=1)
    search.add(np.concatenate([rows, rows[:100]]))
    numbers, distances = search.nearest(rows[42], 3)
    assert list(numbers[:2]) == [42, 542]
    assert distances[0] == 0.0 and distances[1] == 0.0 and distances[2] > 0.0


def test_the_first_look_stays_within_its_bound():
    rows = units(3000, 256, alike=2.0)
    search = CompactSearch(256)
    search.add(rows)
    query = units(1, 256, seed=5)[0]
    half = torch.from_numpy(query).to(torch.bfloat16)
    rough = compact_search._cosines(half, search._steps[:3008], search._scale[:3008])
    rough = rough[:3000].numpy()
    off = np.linalg.norm(query - half.float().numpy())
    bound = search._rounding + 1.05 * off + 1.05 * 2.0**-8
    assert np.abs(rough - rows.astype(float) @ query.astype(float)).max() < bound < 0.03


def test_few_and_none():
    search = CompactSearch(8)
    numbers, distances = search.nearest(np.ones(8) / np.sqrt(8), 5)
    assert len(numbers) == len(distances) == 0
    search.add(units(3, 8))
    assert len(search.nearest(units(1, 8, seed=2)[0], 5)[0]) == 3
    assert search.nbytes == 3 * 42


def test_other_vectors_are_refused():
    search = CompactSearch(8)
    with pytest.raises(DataError, match='8 numbers, got 9'):
        search.add(units(1, 9))
    with pytest.raises(DataError, match='unit length'):
        search.add(2.0 * units(1, 8))
    with pytest.raises(DataError, match='8 numbers, got 9'):
        search.nearest(units(1, 9)[0])
