"""Batches: true motions, what counts as different, augmentation, shards on disk."""

import numpy as np
import pytest
import torch
from lcdnet_samples import street_shard
from scipy.spatial import cKDTree

from lcd_common.errors import DataError
from lcd_loop_closure.lcdnet.augmentation import AugmentationConfig, augmented
from lcd_loop_closure.lcdnet.batches import draw_batch
from lcd_loop_closure.lcdnet.places import PlaceShard

WHOLE = AugmentationConfig(blocked_share=0.0, thinned_share=0.0, near_share=0.0)


def test_true_motions_bring_the_clouds_of_a_place_together():
    batch = draw_batch([street_shard(1), street_shard(2)], 3, WHOLE, np.random.default_rng(0))
    assert batch.clouds.size == 9 and batch.loops == 3 and len(batch.source) == 6
    for pair in range(6):
        source = batch.clouds.xyz[batch.clouds.batch == batch.source[pair]].numpy()
        target = batch.clouds.xyz[batch.clouds.batch == batch.target[pair]].numpy()
        T = batch.T_target_source[pair].numpy()
        away, _ = cKDTree(target).query(source @ T[:3, :3].T + T[:3, 3])
        assert np.percentile(away, 99) < 0.05  # centimetre steps on disk
        assert np.abs(T[:3, :3] - np.eye(3)).max() > 1e-3


def test_other_places_and_towns_are_different():
    batch = draw_batch([street_shard(3, 1), street_shard(4, 1)], 6, WHOLE, np.random.default_rng(1))
    towns = torch.unique(batch.different, dim=0)
    assert len(towns) == 2  # two places in all
    first = batch.different[0]
    assert not first[:3].any() and bool((batch.different == batch.different.T).all())


def test_half_of_the_places_have_no_intensity():
    rng = np.random.default_rng(2)
    dark = 0
    for _ in range(20):
        batch = draw_batch([street_shard(5, 1)], 1, WHOLE, rng)
        light = [float(batch.clouds.intensity[batch.clouds.batch == k].max()) for k in range(3)]
        assert len({value > 0 for value in light}) == 1  # one sensor for a place
        dark += light[0] == 0.0
    assert 4 < dark < 16


def test_augmentation_moves_within_its_limits_and_blocks():
    sweep = street_shard(6, 1).place(0).sweeps[0]
    rng = np.random.default_rng(3)
    yaws = []
    for _ in range(60):
        one = augmented(sweep, AugmentationConfig(), rng)
        T = one.T_new_base
        yaws.append(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
        assert np.abs(T[:2, 3]).max() <= 1.5 and abs(T[2, 3]) <= 0.25
        tilt = np.degrees(np.arccos(T[2, 2]))
        assert tilt <= np.hypot(3, 3) + 0.1
        assert 0 < len(one.xyz) <= len(sweep.xyz) and len(one.xyz) == len(one.intensity)
    assert min(yaws) < -120 and max(yaws) > 120
    blocked = AugmentationConfig(
        blocked_share=1.0, blocked_most=360.0, thinned_share=0.0, near_share=0.0, yaw=0.0, tilt=0.0,
        shift=0.0, lift=0.0,
    )  # fmt: skip
    one = augmented(sweep, blocked, np.random.default_rng(4))
    azimuth = np.sort(np.degrees(np.arctan2(one.xyz[:, 1], one.xyz[:, 0])) % 360.0)
    assert np.diff(np.append(azimuth, azimuth[0] + 360.0)).max() > 60.0


def test_shards_come_back_to_the_centimetre(tmp_path):
    shard = street_shard(7, 2)
    path = tmp_path / 'places_007.safetensors'
    shard.save(path)
    back = PlaceShard.load(path)
    assert back.town == 7 and len(back) == 2 and back.per_place == 3
    for a, b in zip(shard.place(1).sweeps, back.place(1).sweeps, strict=True):
        np.testing.assert_array_equal(a.xyz, b.xyz)
        np.testing.assert_array_equal(a.T_world_base, b.T_world_base)
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(DataError, match='holds no places'):
        PlaceShard.load(path)
