"""LCDNet as a place descriptor, with an untrained network of a size that takes milliseconds."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from lcdnet_samples import TINY as SAMPLE

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError, DataError
from lcd_loop_closure import lcdnet_descriptor
from lcd_loop_closure.lcdnet import Lcdnet
from lcd_loop_closure.lcdnet.checkpoint import save_network
from lcd_loop_closure.lcdnet_descriptor import LcdnetDescriptor
from lcd_loop_closure.lcdnet_settings import LcdnetDescriptorConfig

TINY = replace(
    SAMPLE, group_source=(1, 3), group_radius=(2.5, 6.0), group_count=(8, 8), group_width=(8, 8)
)


def sweep(seed: int = 0, *, intensity: float | None = 1.0) -> PointCloud:
    rng = np.random.default_rng(seed)
    walls = rng.uniform([-20, -20, 0], [20, 20, 6], (400, 3))
    xyz = np.repeat(walls, 10, axis=0) + rng.normal(0, 0.3, (4000, 3))
    shine = None if intensity is None else (intensity * rng.random(4000)).astype(np.float32)
    return PointCloud(xyz.astype(np.float32), shine)


@pytest.fixture(scope='module')
def network():
    import torch

    torch.manual_seed(0)
    return Lcdnet(TINY)


@pytest.fixture
def descriptor(network):
    return LcdnetDescriptor(LcdnetDescriptorConfig(device='cpu'), network)


def test_descriptor_and_features_come_from_one_pass(descriptor, monkeypatch):
    passes = []
    forward = descriptor.network.forward
    monkeypatch.setattr(
        descriptor.network, 'forward', lambda *a, **k: passes.append(1) or forward(*a, **k)
    )
    cloud = sweep()
    row, features = descriptor.describe(cloud), descriptor.features(cloud)
    assert len(passes) == 1
    assert row.shape == (descriptor.length,) == (32,) and row.dtype == np.float32
    assert np.linalg.norm(row) == pytest.approx(1.0, abs=1e-5)
    assert features.keypoints.shape == (48, 3) and features.keypoints.dtype == np.float32
    assert features.values.shape == (48, 16) and features.values.dtype == np.float16
    assert features.nbytes == 48 * (12 + 32)
    descriptor.describe(sweep(1))
    assert len(passes) == 2
    assert np.array_equal(descriptor.describe(PointCloud(cloud.xyz, cloud.intensity)), row)


def test_distances_are_those_of_the_vectors(descriptor):
    rows = np.array([descriptor.row(descriptor.describe(sweep(k))) for k in range(4)])
    distance, yaw = descriptor.compare(rows[2], rows)
    assert yaw is None
    assert distance == pytest.approx(np.linalg.norm(rows - rows[2], axis=1), abs=1e-6)
    assert distance[2] < 1e-6 < distance[0]
    with pytest.raises(DataError, match='32 numbers, got 7'):
        descriptor.row(np.ones(7, np.float32))


def test_points_between_the_voxels_that_training_keeps_change_nothing(descriptor):
    cloud = sweep()
    twice = PointCloud(
        np.concatenate([cloud.xyz, cloud.xyz]), np.concatenate([cloud.intensity] * 2)
    )
    broken = PointCloud(
        np.concatenate([cloud.xyz, np.full((5, 3), np.nan, np.float32)]),
        np.concatenate([cloud.intensity, np.zeros(5, np.float32)]),
    )
    row = descriptor.describe(cloud)
    assert np.array_equal(descriptor.describe(twice), row)
    assert np.array_equal(descriptor.describe(broken), row)


def test_intensity_is_scaled_or_left_out_when_it_is_not_what_was_said(network, caplog):
    def described(cloud, full):
        settings = LcdnetDescriptorConfig(device='cpu', full_intensity=full)
        return LcdnetDescriptor(settings, network).describe(cloud)

    ours, bytes_of, none = sweep(), sweep(intensity=255.0), sweep(intensity=None)
    row = described(ours, 1.0)
    assert described(bytes_of, 255.0) == pytest.approx(row, abs=1e-5)
    blind = described(none, 1.0)
    assert not np.allclose(blind, row, atol=1e-4)
    assert np.array_equal(described(ours, 0.0), blind)
    with caplog.at_level(logging.WARNING):
        assert np.array_equal(described(bytes_of, 1.0), blind)
    assert 'full_intensity' in caplog.text


def test_too_few_points_are_refused(descriptor):
    with pytest.raises(DataError, match='at least 100 points'):
        descriptor.describe(PointCloud(np.empty((0, 3), np.float32)))
    far = sweep().transformed(se3.from_rotation_translation(np.eye(3), [500.0, 0, 0]))
    with pytest.raises(DataError, match='within its reach, got 0'):
        descriptor.describe(far)


def test_weights_come_from_a_file(network, tmp_path):
    path = tmp_path / 'weights.safetensors'
    save_network(path, network, {})
    settings = LcdnetDescriptorConfig(weights=str(path), device='cpu')
    cloud = sweep()
    expected = LcdnetDescriptor(LcdnetDescriptorConfig(device='cpu'), network).describe(cloud)
    assert np.array_equal(LcdnetDescriptor(settings).describe(cloud), expected)


def test_missing_and_wrong_weights_are_one_line(tmp_path, monkeypatch):
    monkeypatch.setattr(lcdnet_descriptor, 'PACKAGED', tmp_path / 'none.safetensors')
    with pytest.raises(ConfigError, match='expected the weights of LCDNet, found none') as error:
        LcdnetDescriptor(LcdnetDescriptorConfig())
    assert '\n' not in str(error.value) and 'train_lcdnet' in str(error.value)
    with pytest.raises(ConfigError, match='check the path'):
        LcdnetDescriptor(LcdnetDescriptorConfig(weights=str(tmp_path / 'gone')))
    wrong = tmp_path / 'wrong.safetensors'
    wrong.write_text('not weights')
    with pytest.raises(DataError, match=r'best\.safetensors') as other:
        LcdnetDescriptor(LcdnetDescriptorConfig(weights=str(wrong)))
    assert '\n' not in str(other.value)


def test_a_device_that_is_not_there(network):
    with pytest.raises(ConfigError, match='device'):
        LcdnetDescriptor(LcdnetDescriptorConfig(device='abacus'), network)
