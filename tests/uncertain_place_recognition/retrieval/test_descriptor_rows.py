import numpy as np
import pytest

from uncertain_place_recognition.retrieval.descriptor_rows import DescriptorRows, directions


def test_rows_survive_growing_and_room_doubles():
    rng = np.random.default_rng(0)
    rows, kept = DescriptorRows(4, capacity=2), []
    rooms = set()
    for number in range(100):
        kept.append(rng.normal(size=4).astype(np.float32))
        rows.append(np.array([number]), kept[-1][None])
        rooms.add(len(rows._rows))
    assert np.array_equal(rows.rows, kept)
    assert rows.place_id.tolist() == list(range(100))
    assert rooms == {2, 4, 8, 16, 32, 64, 128}


@pytest.mark.parametrize('metric', ['cosine', 'euclidean'])
def test_far_from_the_origin_short_distances_keep_their_order(metric):
    # |r - q|^2 by products loses all digits here: 1e-3 beside 1e4.
    rng = np.random.default_rng(3)
    base = rng.normal(size=32)
    base *= 100.0 / np.linalg.norm(base)
    rows = (base + rng.normal(0, 1e-3, (2000, 32))).astype(np.float32)
    held = DescriptorRows(32)
    held.append(np.arange(2000), rows)
    query = rows[77] + np.float32(1e-4)
    whole, asked = rows.astype(np.float64), query.astype(np.float64)
    apart = np.linalg.norm(whole - asked, axis=1)
    cosine = whole @ asked / np.linalg.norm(whole, axis=1) / np.linalg.norm(asked)
    order = np.argsort(apart if metric == 'euclidean' else -cosine, kind='stable')
    assert held.nearest(query, 5, metric).place_id.tolist() == order[:5].tolist()


def test_directions_have_unit_length():
    rows = directions(np.array([[3.0, 4.0], [0.0, 0.0]], np.float32))
    assert np.linalg.norm(rows, axis=1) == pytest.approx([1.0, 1.0])
    assert rows[0] == pytest.approx([0.6, 0.8])
