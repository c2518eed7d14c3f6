from dataclasses import replace

import pytest
import torch
from small_samples import SMALL

from cmrnet_ekf.networks.checkpoint import begin_from, save_network
from cmrnet_ekf.networks.cmrnet import Cmrnet
from lcd_common.errors import ConfigError


def test_a_network_begins_with_the_trunk_of_another_head(tmp_path):
    torch.manual_seed(0)
    plain = Cmrnet(SMALL)
    path = tmp_path / 'plain.safetensors'
    save_network(path, plain, {})
    evidential = Cmrnet(replace(SMALL, head='evidential'))
    outputs = evidential.head.translation[1].weight.clone()
    fresh = begin_from(evidential, path)
    assert sorted(fresh) == [
        'head.rotation.1.bias', 'head.rotation.1.weight',
        'head.translation.1.bias', 'head.translation.1.weight',
    ]  # fmt: skip
    image = torch.randint(0, 256, (2, 3, 32, 64), dtype=torch.uint8)
    lidar = torch.rand(2, 32, 64) * 50
    assert torch.equal(evidential.trunk(image, lidar), plain.trunk(image, lidar))
    assert torch.equal(evidential.head.translation[1].weight, outputs)
    assert begin_from(Cmrnet(SMALL), path) == []


def test_another_trunk_is_refused(tmp_path):
    path = tmp_path / 'plain.safetensors'
    save_network(path, Cmrnet(SMALL), {})
    with pytest.raises(ConfigError, match='same shape but for its head'):
        begin_from(Cmrnet(replace(SMALL, squeezed=6)), path)
