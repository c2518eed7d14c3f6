"""The network on the view from above: its image by counting, turns in the polar view."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from small_runs import turned

from lcd_common.errors import ConfigError
from uncertain_place_recognition.networks.bev_netvlad import COMPACT, BevNetVlad, BevNetVladConfig


@pytest.mark.parametrize('view', ['cartesian', 'polar'])
def test_the_image_counts_points(view):
    settings = BevNetVladConfig(
        view=view, rows=8, columns=12, slabs=(0.1,), widths=(4,), blocks=(1,), clusters=2, size=4
    )
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.3, -1.3, 0], [1.3, 1.3, 0.2], (2, 50, 3)).astype(np.float32)
    points[0, :20] = points[0, 20]
    expected = np.zeros((2, 2, 8, 12))
    for cloud in range(2):
        for x, y, z in points[cloud]:
            if view == 'polar':
                row = int(np.floor(np.hypot(x, y) * 8))
                column = int((np.arctan2(y, x) / (2 * np.pi) + 0.5) * 12) % 12
            else:
                row, column = int(np.floor((x + 1) * 4)), int(np.floor((y + 1) * 6))
            if 0 <= row < 8 and 0 <= column < 12:
                expected[cloud, int(z > 0.1), row, column] += 1
    found = BevNetVlad(settings).prepare(torch.from_numpy(points))
    np.testing.assert_allclose(found.numpy(), np.log1p(expected), rtol=1e-6)


def test_a_turn_by_whole_columns_changes_nothing_in_the_polar_view():
    torch.manual_seed(0)
    settings = replace(COMPACT, view='polar', rows=16, columns=32, slabs=())
    network = BevNetVlad(settings).eval()
    # In the middles of cells, so that no rounding moves a point to the next.
    column, row = np.meshgrid(np.arange(32), np.arange(16))
    chosen = np.random.default_rng(1).random(column.shape) < 0.2
    azimuth, radius = (column[chosen] + 0.5) / 32 * 2 * np.pi, (row[chosen] + 0.5) / 16
    points = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), 0 * radius], 1)
    # Strides halve the columns three times: a turn by eight columns stays on all their grids.
    both = np.stack([points, turned(points, 90.0), turned(points, 17.0)]).astype(np.float32)
    with torch.no_grad():
        found = network.embed(torch.from_numpy(both))
    torch.testing.assert_close(found[0], found[1], rtol=1e-4, atol=1e-5)
    assert float((found[0] - found[2]).norm()) > 1e-3


def test_shapes_that_cannot_be_are_refused():
    with pytest.raises(ConfigError, match='number of blocks'):
        BevNetVlad(BevNetVladConfig(widths=(4, 8), blocks=(1,)))
    with pytest.raises(ConfigError, match='slabs must rise'):
        BevNetVlad(BevNetVladConfig(slabs=(0.2, 0.1)))
