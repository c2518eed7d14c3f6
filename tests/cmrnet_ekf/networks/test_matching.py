import numpy as np
import pytest
import torch
from torch.nn import functional

from cmrnet_ekf import euler
from cmrnet_ekf.networks.matching import cell_matches, matching_loss

FX, FY, CX, CY = 60.0, 55.0, 31.0, 17.0
CAMERA = torch.tensor([[FX, FY, CX, CY]])
HEIGHT, WIDTH, CELL, D = 32, 64, 8, 3


def by_hand(lidar: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Take each pixel of the map to the true camera, one by one."""
    R, t = euler.rotations(target[3:]), target[:3]
    counts = np.zeros((2 * D + 1, 2 * D + 1, HEIGHT // CELL, WIDTH // CELL))
    for v, u in np.argwhere(lidar > 0):
        z = lidar[v, u]
        p_guess = np.array([z, -(u - CX) / FX * z, -(v - CY) / FY * z])
        x, y, z = R.T @ (p_guess - t)
        if x <= 0.5:
            continue
        row, column = np.floor(CY - FY * z / x + 0.5), np.floor(CX - FX * y / x + 0.5)
        if not (0 <= row < HEIGHT and 0 <= column < WIDTH):
            continue
        row, column = int(row) // CELL, int(column) // CELL
        down, right = v // CELL - row + D, u // CELL - column + D
        if 0 <= down <= 2 * D and 0 <= right <= 2 * D:
            counts[down, right, row, column] += 1
    return counts.reshape(-1, HEIGHT // CELL, WIDTH // CELL)


def test_matches_are_those_found_pixel_by_pixel():
    rng = np.random.default_rng(0)
    lidar = rng.uniform(3, 40, (2, HEIGHT, WIDTH)).astype(np.float32)
    lidar[rng.random(lidar.shape) < 0.7] = 0.0
    targets = np.array([[1.0, -0.5, 0.3, 0.05, -0.1, 0.17], [-1.5, 0.8, 0.0, 0.0, 0.02, -0.1]])
    found = cell_matches(
        torch.from_numpy(lidar), torch.from_numpy(targets).float(), CAMERA.expand(2, 4),
        (HEIGHT // CELL, WIDTH // CELL), D,
    )  # fmt: skip
    expected = np.stack([by_hand(*pair) for pair in zip(lidar, targets, strict=True)])
    assert expected.sum() > 300
    # A pixel on the border of two cells may fall into either by rounding.
    assert np.abs(found.numpy() - expected).sum() <= 4


def test_a_right_guess_matches_each_cell_with_itself():
    lidar = torch.full((1, HEIGHT, WIDTH), 10.0)
    found = cell_matches(lidar, torch.zeros(1, 6), CAMERA, (HEIGHT // CELL, WIDTH // CELL), D)
    middle = (2 * D + 1) ** 2 // 2
    assert (found[0, middle] == CELL * CELL).all() and found.sum() == HEIGHT * WIDTH


def test_the_loss_is_the_cross_entropy_of_cells_that_show_the_map():
    torch.manual_seed(0)
    correlation = torch.randn(2, 9, 2, 3)
    label = torch.randint(0, 9, (2, 2, 3))
    matches = 5.0 * functional.one_hot(label, 9).permute(0, 3, 1, 2).float()
    matches[0, :, 1, 2] = 0.0
    label[0, 1, 2] = -100
    expected = functional.cross_entropy(4.0 * correlation, label)
    assert float(matching_loss(correlation, matches, 4.0)) == pytest.approx(float(expected))
    assert float(matching_loss(correlation, torch.zeros_like(matches), 4.0)) == 0.0


def test_rotations_are_those_of_numpy():
    angles = np.random.default_rng(1).uniform(-1.5, 1.5, (20, 3))
    found = euler.rotation_tensor(torch.from_numpy(angles))
    np.testing.assert_allclose(found.numpy(), euler.rotations(angles), atol=1e-12)
