"""Several teachers teach by the mean of what they say."""

from dataclasses import replace

import pytest
import torch

from lcd_common.errors import ConfigError
from uncertain_place_recognition.networks.shapes import build, shape
from uncertain_place_recognition.training.mean_teacher import MeanTeacher

SHAPE = replace(shape('bev_netvlad'), rows=8, columns=16, widths=(6, 8), blocks=(1, 1),
                clusters=4, size=8)  # fmt: skip


def network(seed, settings=SHAPE):
    torch.manual_seed(seed)
    return build(settings).eval()


def test_its_embedding_is_the_mean_of_its_members():
    members = [network(seed) for seed in range(3)]
    points = torch.rand(2, 64, 3, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    with torch.no_grad():
        expected = torch.stack([one.embed(points) for one in members]).mean(0)
        torch.testing.assert_close(MeanTeacher(members).eval().embed(points), expected)


def test_members_of_other_shapes_are_refused():
    with pytest.raises(ConfigError, match='one shape'):
        MeanTeacher([])
    with pytest.raises(ConfigError, match='one shape'):
        MeanTeacher([network(0), network(1, replace(SHAPE, size=4))])
