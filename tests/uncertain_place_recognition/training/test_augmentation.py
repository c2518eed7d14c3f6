"""Changed submaps: turned, shifted, thinned, and always whole numbers of points."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from uncertain_place_recognition.training.augmentation import AugmentationConfig, augmented

NOTHING = AugmentationConfig(yaw=0, flip=0, shift=0, jitter=0, removed=0, erased=0)


def _points(count=500, clouds=4):
    rng = np.random.default_rng(0)
    return torch.from_numpy(rng.uniform(-0.9, 0.9, (clouds, count, 3)).astype(np.float32))


def _changed(seed=0, **values):
    settings = AugmentationConfig(**{k: values.get(k, getattr(NOTHING, k)) for k in vars(NOTHING)})
    return augmented(_points(), settings, torch.Generator().manual_seed(seed))


def test_nothing_asked_for_changes_nothing():
    torch.testing.assert_close(_changed(), _points())


def test_turns_keep_heights_and_distances_and_differ_by_submap():
    before, after = _points(), _changed(yaw=180.0)
    torch.testing.assert_close(after[..., 2], before[..., 2])
    between = [torch.cdist(x.double(), x.double()) for x in (before, after)]
    torch.testing.assert_close(*between, atol=1e-5, rtol=0)
    turn = torch.atan2(after[..., 1], after[..., 0]) - torch.atan2(before[..., 1], before[..., 0])
    turn = torch.remainder(turn + 4 * np.pi, 2 * np.pi)
    angles = turn.median(1).values
    assert len({round(float(a), 3) for a in angles}) == 4
    small = _changed(yaw=5.0)
    most = 2 * np.sin(np.radians(2.5)) * 0.9 * 2**0.5  # the chord of the farthest corner
    assert 0.0 < float((small - before).norm(dim=2).max()) <= most + 1e-5


def test_flips_mirror_all_submaps_of_a_batch_alike():
    seen = set()
    for seed in range(30):
        ratio = (_changed(seed, flip=0.5) / _points()).round()
        assert (ratio == ratio[0, 0]).all()
        seen.add(tuple(ratio[0, 0].tolist()))
    assert seen == {(x, y, 1.0) for x in (1.0, -1.0) for y in (1.0, -1.0)}


def test_jitter_and_shift_are_of_the_size_asked_for():
    jitter = _changed(jitter=0.01) - _points()
    assert float(jitter.abs().max()) <= 0.02 + 1e-6
    assert float(jitter.std()) == pytest.approx(0.0088, rel=0.1)  # a normal cut off at two sigma
    shift = _changed(shift=0.05) - _points()
    torch.testing.assert_close(shift, shift[:, :1].expand_as(shift), atol=1e-6, rtol=0)
    assert float(shift.norm(dim=2).max()) > 0.01


@pytest.mark.parametrize('values', [{'removed': 0.5}, {'erased': 1.0}])
def test_what_is_removed_gives_way_to_points_that_stay(values):
    before = _points()
    gone = []
    for seed in range(20):
        after = _changed(seed, **values)
        assert after.shape == before.shape
        for cloud, changed in zip(before.numpy(), after.numpy(), strict=True):
            distance, index = cKDTree(cloud).query(changed)
            assert distance.max() < 1e-6  # no point is new
            left = np.unique(index)
            gone.append(1.0 - len(left) / len(cloud))
            if 'erased' in values:  # what is gone is a rectangle
                lost = np.setdiff1d(np.arange(len(cloud)), left)
                low, high = cloud[lost, :2].min(0), cloud[lost, :2].max(0)
                inside = ((cloud[left, :2] > low) & (cloud[left, :2] < high)).all(1)
                assert not inside.any()
    most = 0.5 if 'removed' in values else 0.40
    assert np.mean(gone) > 0.05 and max(gone) < most + 0.08


def test_the_same_generator_gives_the_same():
    settings = AugmentationConfig()
    one, other = (
        augmented(_points(), settings, torch.Generator().manual_seed(5)) for _ in range(2)
    )
    torch.testing.assert_close(one, other, rtol=0, atol=0)
