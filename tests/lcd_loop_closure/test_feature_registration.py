"""Registration by features: known motions under many wrong matches."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lcd_common import se3
from lcd_loop_closure.feature_registration import (
    FeatureRegistration,
    FeatureRegistrationConfig,
    rigid_motion,
    truncated_motion,
)


def _pair(seed, count=300, wrong=0.6, noise=0.2):
    """Return keypoints and features of two views, and T_match_query."""
    rng = np.random.default_rng(seed)
    query = np.column_stack([rng.uniform(-40, 40, (count, 2)), rng.uniform(0, 8, count)])
    angles = [rng.uniform(-180, 180), rng.uniform(-3, 3), rng.uniform(-3, 3)]
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler('ZYX', angles, degrees=True).as_matrix()
    T[:3, 3] = *rng.uniform(-12, 12, 2), rng.uniform(-0.5, 0.5)
    match = query @ T[:3, :3].T + T[:3, 3] + rng.normal(0, noise, (count, 3))
    features = rng.normal(size=(count, 32)).astype(np.float32)
    other = features + 0.2 * rng.normal(size=features.shape).astype(np.float32)
    swapped = rng.permutation(count)[: int(wrong * count)]
    other[swapped] = other[rng.permutation(swapped)]
    return query, features, match, other, T


@pytest.mark.parametrize('seed', range(8))
def test_the_motion_is_found_among_wrong_matches(seed):
    query, features, match, other, T = _pair(seed)
    found = FeatureRegistration().search(query, features, match, other)
    metres, radians = se3.distance(found[0].T_match_query, T)
    assert metres < 0.15 and np.degrees(radians) < 0.4
    assert found[0].inliers >= 0.35 * 300


def test_the_same_features_give_the_same_answer():
    pair = _pair(3)[:4]
    first, second = (FeatureRegistration().search(*pair)[0] for _ in range(2))
    np.testing.assert_array_equal(first.T_match_query, second.T_match_query)


def test_unlike_clouds_have_few_inliers_and_empty_ones_no_answer():
    query, features, match, other, _ = _pair(1, wrong=1.0)
    found = FeatureRegistration().search(query, features, match, other)
    assert all(one.inliers < 30 for one in found)
    registration = FeatureRegistration(FeatureRegistrationConfig(neighbours=1))
    assert registration.search(query[:2], features[:2], match[:2], other[:2]) == []


def test_matches_are_mutual_nearest_neighbours():
    rng = np.random.default_rng(5)
    a, b = rng.normal(size=(20, 8)).astype(np.float32), rng.normal(size=(25, 8)).astype(np.float32)
    cosine = (a / np.linalg.norm(a, axis=1)[:, None]) @ (b / np.linalg.norm(b, axis=1)[:, None]).T
    expected = {
        (i, j)
        for i in range(20)
        for j in range(25)
        if cosine[i].argmax() == j and cosine[:, j].argmax() == i
    }
    rows, columns, values = FeatureRegistration(FeatureRegistrationConfig(neighbours=1)).matches(
        a, b
    )
    assert set(zip(rows.tolist(), columns.tolist(), strict=True)) == expected
    np.testing.assert_allclose(values, cosine[rows, columns], atol=1e-6)


@pytest.mark.parametrize('seed', range(4))
def test_graduated_non_convexity_leaves_wrong_matches_out(seed):
    rng = np.random.default_rng(seed)
    p = rng.uniform(-30, 30, (200, 3))
    T = se3.from_rotation_translation(
        Rotation.random(random_state=seed).as_matrix(), [3.0, -8.0, 1]
    )
    q = se3.transform_points(T, p) + rng.normal(0, 0.05, p.shape)
    q[:100] += rng.uniform(-40, 40, (100, 3))
    metres, radians = se3.distance(truncated_motion(p, q, 0.5), T)
    assert metres < 0.05 and radians < 0.002
    plain = rigid_motion(p, q, np.ones(200))
    assert se3.distance(plain, T)[0] > 0.3
