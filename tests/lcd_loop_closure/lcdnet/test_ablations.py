"""The other backbones and pose heads of the thesis's ablation tables."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from lcdnet_samples import TINY, street, street_shard
from scipy.spatial.transform import Rotation

from lcd_loop_closure.lcdnet import Lcdnet, pose_heads
from lcd_loop_closure.lcdnet.training import Trainer, TrainingConfig
from lcd_loop_closure.lcdnet.voxels import Clouds


@pytest.mark.parametrize('backbone', ['pointnet', 'edgeconv', 'randla'])
def test_backbones_describe_keypoints_whatever_their_order_in_the_cloud(backbone):
    torch.manual_seed(0)
    network = Lcdnet(replace(TINY, backbone=backbone)).eval()
    xyz = torch.from_numpy(street(np.random.default_rng(0)))
    with torch.no_grad():
        found = network(Clouds.of([xyz, xyz + 1.0]))
        again = network(Clouds.of([xyz[torch.randperm(len(xyz))]]))
    assert found.features.shape == (2, 48, 16)
    torch.testing.assert_close(found.features[0], again.features[0], atol=1e-3, rtol=1e-2)
    assert float((found.descriptors[0] - found.descriptors[1]).norm()) > 0.0


@pytest.mark.parametrize('head', ['mlp_sincos', 'mlp_quaternion', 'mlp_bingham'])
def test_heads_give_rotations_and_learn(head, tmp_path):
    torch.manual_seed(0)
    network = Lcdnet(replace(TINY, pose_head=head))
    settings = TrainingConfig(steps=60, places=3, learning_rate=0.01, warmup=1, clip=0.0)
    records = list(Trainer(network, [street_shard(1)], tmp_path, settings).run())
    assert np.mean([r.pose_m for r in records[-20:]]) < np.mean([r.pose_m for r in records[:20]])
    assert records[0].transport_m == 0.0
    xyz = torch.from_numpy(street(np.random.default_rng(1)))
    with torch.no_grad():
        features = network.eval()(Clouds.of([xyz, xyz]))
        R = network.relative_pose(features, torch.tensor([0]), torch.tensor([1]))[0, :3, :3]
    torch.testing.assert_close(R @ R.T, torch.eye(3), atol=1e-5, rtol=0)
    assert float(torch.linalg.det(R)) == pytest.approx(1.0, abs=1e-5)


def test_rotations_are_those_of_scipy():
    q = torch.randn(5, 4, generator=torch.Generator().manual_seed(0))
    expected = Rotation.from_quat(q.numpy()).as_matrix()
    np.testing.assert_allclose(pose_heads._from_quaternion(q).numpy(), expected, atol=1e-5)
    angle = np.array([0.3, -2.0])
    values = 3.0 * np.column_stack([np.sin(angle), np.cos(angle)])
    np.testing.assert_allclose(
        pose_heads._from_sine_and_cosine(torch.from_numpy(values)).numpy(),
        Rotation.from_rotvec(angle[:, None] * [[0.0, 0.0, 1.0]]).as_matrix(),
        atol=1e-12,
    )


def test_bingham_returns_the_mode():
    rng = np.random.default_rng(3)
    mode = rng.normal(size=4)
    mode /= np.linalg.norm(mode)
    A = np.eye(4) - np.outer(mode, mode)  # the mode alone has the eigenvalue zero
    rows, columns = np.triu_indices(4)
    got = pose_heads._from_bingham(torch.from_numpy(A[rows, columns])[None])[0].numpy()
    np.testing.assert_allclose(got, Rotation.from_quat(mode).as_matrix(), atol=1e-9)
