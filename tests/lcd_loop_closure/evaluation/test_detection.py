"""Both protocols, by class, against their definitions counted pair by pair."""

import numpy as np
import pytest

from lcd_common import se3
from lcd_loop_closure.evaluation import detection
from lcd_loop_closure.evaluation.detection import judge_descriptor, passed_reverse
from lcd_loop_closure.evaluation.pair_protocol import PairScores, protocol_2
from lcd_loop_closure.revisits import RevisitConfig

SETTINGS = RevisitConfig(first_scan=10, excluded_scans=5, distance=4.0)


def there_and_back_again(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Drive a street, drive it back, drive it again; descriptors are positions with noise."""
    rng = np.random.default_rng(1)
    x = np.concatenate([np.arange(0, 60, 1.5), np.arange(60, 0, -1.5), np.arange(0, 60, 1.5)])
    yaw = np.repeat([0.0, np.pi, 0.0], 40)
    poses = np.array([se3.rotation_z(angle) for angle in yaw])
    poses[:, 0, 3] = x
    poses[:, 1, 3] = rng.normal(0.0, 1.0, len(x))
    descriptors = poses[:, :3, 3] + rng.normal(0.0, noise, (len(x), 3))
    return poses, descriptors.astype(np.float32)


def all_pairs(poses, descriptors):
    """Yield (distance, near, reverse) of every pair j < i - 5, i >= 10."""
    for i in range(10, len(poses)):
        for j in range(i - 5):
            near = np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3]) <= 4.0
            turn = abs(se3.yaw(poses[i]) - se3.yaw(poses[j])) % (2 * np.pi)
            distance = np.linalg.norm(descriptors[j] - descriptors[i])
            yield np.float32(distance), near, 0.79 <= turn <= 5.5


def average_precision(scores: list[tuple[float, bool]]) -> float:
    """Scikit-learn's definition, threshold by threshold."""
    distance, right = (np.array(column) for column in zip(*scores, strict=True))
    total, area, recall_before = right.sum(), 0.0, 0.0
    for threshold in sorted(set(distance)):
        accepted = right[distance <= threshold]
        recall = accepted.sum() / total
        area += (recall - recall_before) * accepted.mean()
        recall_before = recall
    return area


@pytest.mark.parametrize('noise', [0.5, 3.0, 30.0])
def test_protocol_2_is_that_of_the_definition(monkeypatch, noise):
    monkeypatch.setattr(detection, '_BLOCK_PAIRS', 1000)
    poses, descriptors = there_and_back_again(noise)
    # Coarse distances: many pairs share one.
    descriptors = np.round(descriptors)
    judged = judge_descriptor(
        lambda i, m: np.linalg.norm(descriptors[:m] - descriptors[i], axis=1), poses, SETTINGS
    )
    pairs = list(all_pairs(poses, descriptors))
    assert judged.pairs == len(pairs)
    for kind, keep in (
        ('all', lambda near, reverse: True),
        ('same_way', lambda near, reverse: not (near and reverse)),
        ('reverse', lambda near, reverse: not near or reverse),
    ):
        chosen = [(d, near) for d, near, reverse in pairs if keep(near, reverse)]
        curve = judged.protocol_2[kind]
        assert curve.loops == sum(near for _, near in chosen) > 0
        assert curve.average_precision == pytest.approx(average_precision(chosen), rel=1e-9)
        f1 = max(
            2 * p * r / (p + r)
            for p, r in zip(curve.precision, curve.recall, strict=True) if p + r
        )  # fmt: skip
        assert curve.f1_max == pytest.approx(f1)


def test_protocol_2_agrees_with_scikit_learn_on_random_scores():
    metrics = pytest.importorskip('sklearn.metrics', reason='scikit-learn is not installed')
    rng = np.random.default_rng(0)
    positive, negative = rng.normal(0, 1, 300).astype('f4'), rng.normal(1, 1, 9000).astype('f4')
    curve = protocol_2(PairScores(positive, np.zeros(300, bool), (negative,)))
    expected = metrics.average_precision_score(
        np.r_[np.ones(300), np.zeros(9000)], -np.r_[positive, negative]
    )
    assert curve.average_precision == pytest.approx(expected)


def test_protocol_1_by_class_leaves_the_other_class_out():
    poses, descriptors = there_and_back_again(1.0)
    # A descriptor that knows the heading finds nothing in reverse.
    heading = np.where(np.abs(poses[:, 0, 0] + 1.0) < 1e-6, 1000.0, 0.0)
    descriptors = np.column_stack([descriptors, heading])
    judged = judge_descriptor(
        lambda i, m: np.linalg.norm(descriptors[:m] - descriptors[i], axis=1), poses, SETTINGS
    )
    assert judged.protocol_1['same_way'].average_precision > 0.5
    assert judged.protocol_1['reverse'].average_precision < 0.05
    loops = {kind: curve.loops for kind, curve in judged.protocol_1.items()}
    assert loops['all'] == loops['same_way'] + loops['reverse']
    assert loops['same_way'] > 20 and loops['reverse'] > 20
    plain = judged.plain()
    assert plain['protocol_1']['all']['loops'] == loops['all']


def test_a_drive_without_revisits_has_no_figures():
    poses = np.tile(np.eye(4), (50, 1, 1))
    poses[:, 0, 3] = 5.0 * np.arange(50)
    judged = judge_descriptor(lambda i, m: np.arange(m, 0, -1.0), poses, SETTINGS)
    assert judged.plain()['protocol_1']['all'] is None
    assert judged.plain()['recall_1'] is None
    assert judged.protocol_2['reverse'].average_precision == 0.0


def test_too_short_a_drive():
    judged = judge_descriptor(lambda i, m: np.zeros(m), np.tile(np.eye(4), (4, 1, 1)), SETTINGS)
    assert judged.pairs == 0 and judged.plain()['protocol_2']['all'] is None


def test_no_distance_is_infinitely_far():
    curve = protocol_2(
        PairScores(
            np.array([0.1, np.inf], 'f4'), np.zeros(2, bool), (np.array([0.2, np.inf], 'f4'),)
        )
    )
    # At 0.1: 1 of 1; at infinity: 2 of 4.
    assert curve.average_precision == pytest.approx(0.5 * 1.0 + 0.5 * 0.5)


def test_headings_of_both_ways():
    turned = np.array([0.0, 0.7, 0.8, np.pi, -np.pi, -0.7, 6.2])
    assert list(passed_reverse(0.0, turned)) == [False, False, True, True, True, False, False]


def test_ten_million_pairs_take_little_memory():
    rng = np.random.default_rng(0)
    negative = tuple(rng.random(1_000_000, np.float32) for _ in range(10))
    positive = rng.random(20_000, np.float32) * np.float32(0.5)
    curve = protocol_2(PairScores(positive, np.zeros(len(positive), bool), negative))
    # By expectation: recall r at distance r / 2, where r / 2 of the negatives are accepted.
    r = np.linspace(1e-4, 1, 10_000)
    expected = np.mean(20_000 * r / (20_000 * r + 1e7 * r / 2))
    assert curve.average_precision == pytest.approx(expected, rel=0.05)
