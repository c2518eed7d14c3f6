"""Check what cells say of where they are found against loops over cells and displacements."""

import numpy as np
import pytest
import torch

from cmrnet_ekf.networks.cell_flow import CHANNELS, cell_flow

D, ROWS, COLUMNS, CELL, FOCAL = 2, 3, 5, 4, 40.0


def lidar_image(seed: int = 0) -> torch.Tensor:
    rng = torch.Generator().manual_seed(seed)
    depth = 2.0 + 30.0 * torch.rand(1, ROWS * CELL, COLUMNS * CELL, generator=rng)
    return depth * (torch.rand(depth.shape, generator=rng) < 0.4)


def cells_of(lidar: torch.Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean inverse depth and the seen share of each cell."""
    inverse, share = np.zeros((ROWS, COLUMNS)), np.zeros((ROWS, COLUMNS))
    for r in range(ROWS):
        for c in range(COLUMNS):
            z = lidar[0, r * CELL : (r + 1) * CELL, c * CELL : (c + 1) * CELL].numpy().ravel()
            share[r, c] = (z > 0).mean()
            inverse[r, c] = (1.0 / z[z > 0]).mean() if (z > 0).any() else 0.0
    return inverse, share


def test_channels_are_those_of_a_softmax_over_displacements():
    lidar = lidar_image()
    lidar[0, :CELL, :CELL] = 0.0  # a cell without map
    correlation = torch.randn(1, (2 * D + 1) ** 2, ROWS, COLUMNS, generator=torch.manual_seed(1))
    found = cell_flow(correlation, lidar, D, 3.0, FOCAL)[0].numpy()
    inverse, share = cells_of(lidar)
    for r in range(ROWS):
        for c in range(COLUMNS):
            weights, steps, mass = [], [], 0.0
            for k in range((2 * D + 1) ** 2):
                down, right = k // (2 * D + 1) - D, k % (2 * D + 1) - D
                row, column = r + down, c + right
                if not (0 <= row < ROWS and 0 <= column < COLUMNS) or not share[row, column]:
                    continue
                weights.append(np.exp(3.0 * float(correlation[0, k, r, c])))
                steps.append((down, right, inverse[row, column]))
                mass += share[row, column]
            down, right, there = np.average(steps, axis=0, weights=weights)
            metres = CELL / (there * FOCAL * 2.0)
            expected = [
                down / D, right / D, 10 * there, down * metres, right * metres,
                max(weights) / sum(weights), mass / (2 * D + 1) ** 2, 10 * inverse[r, c],
            ]  # fmt: skip
            np.testing.assert_allclose(found[:, r, c], expected, rtol=2e-5, atol=1e-6)


def test_nothing_is_found_where_no_map_is_seen():
    correlation = torch.randn(2, (2 * D + 1) ** 2, ROWS, COLUMNS)
    found = cell_flow(correlation, torch.zeros(2, ROWS * CELL, COLUMNS * CELL), D, 3.0, FOCAL)
    assert found.shape == (2, CHANNELS, ROWS, COLUMNS)
    assert not found.any()


@pytest.mark.parametrize('shift', [-1, 0, 2])
def test_a_sharp_correlation_gives_its_displacement_and_the_depth_there(shift):
    lidar = torch.full((1, ROWS * CELL, COLUMNS * CELL), 8.0)
    lidar[:, :, 2 * CELL : 3 * CELL] = 4.0
    correlation = torch.zeros(1, (2 * D + 1) ** 2, ROWS, COLUMNS)
    correlation[:, D * (2 * D + 1) + D + shift] = 1.0
    found = cell_flow(correlation, lidar, D, 50.0, FOCAL)[0, :, 1, 2]
    depth = 4.0 if shift == 0 else 8.0
    expected = [0.0, shift / D, 10 / depth, 0.0, shift * CELL * depth / FOCAL / 2, 1.0]
    np.testing.assert_allclose(found[:6].numpy(), expected, atol=1e-5)


def test_gradients_reach_the_correlation():
    correlation = torch.randn(1, 25, ROWS, COLUMNS, dtype=torch.float64, requires_grad=True)
    lidar = lidar_image(3).double()
    assert torch.autograd.gradcheck(
        lambda x: cell_flow(x, lidar, D, 1.0, FOCAL)[:, :5], (correlation,), atol=1e-3, rtol=1e-2,
        eps=1e-3,
    )  # fmt: skip
