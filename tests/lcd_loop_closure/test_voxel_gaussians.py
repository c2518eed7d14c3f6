"""Voxels hold what numpy finds in them."""

import numpy as np

from lcd_loop_closure.voxel_gaussians import VoxelGaussians

RNG = np.random.default_rng(5)


def test_moments_are_those_of_the_points() -> None:
    # Far from the origin, where sums of squares would cancel.
    points = np.array([5000.0, -3000.0, 40.0]) + RNG.uniform(-8, 8, (6000, 3))
    grid = VoxelGaussians(2.0, 100.0, full_at=10_000)
    origin = points.mean(axis=0)
    for part in np.array_split(points, 4):
        grid.add(part, origin)
    cells = np.floor(points / 2.0)
    keys, which = np.unique(cells, axis=0, return_inverse=True)
    assert len(grid) == len(keys)
    which = which.ravel()
    for k in range(len(keys)):
        inside = points[which == k]
        if len(inside) < 3:
            continue
        found = grid.gaussians(grid.find(inside[:1]))
        assert found.count[0] == len(inside)
        np.testing.assert_allclose(found.mean[0], inside.mean(axis=0), atol=1e-9)
        covariance = (found.axes[0] * found.variance[0]) @ found.axes[0].T
        np.testing.assert_allclose(covariance, np.cov(inside.T), atol=1e-9)


def test_unknown_and_thin_voxels_are_not_found() -> None:
    grid = VoxelGaussians(1.0, 50.0)
    grid.add(np.array([[0.5, 0.5, 0.5], [0.6, 0.5, 0.5], [3.5, 0.5, 0.5]]), np.zeros(3))
    asked = np.array([[0.1, 0.9, 0.2], [3.1, 0.1, 0.1], [9.0, 9.0, 9.0], [-0.5, 0.5, 0.5]])
    assert (grid.find(asked) >= 0).tolist() == [True, True, False, False]
    assert (grid.find(asked, 2) >= 0).tolist() == [True, False, False, False]
    assert VoxelGaussians(1.0, 50.0).find(asked).tolist() == [-1] * 4


def test_a_full_voxel_stays_as_it_is() -> None:
    grid = VoxelGaussians(1.0, 50.0, full_at=20)
    first = RNG.uniform(0, 1, (25, 3))
    grid.add(first, np.zeros(3))
    grid.add(RNG.uniform(0, 0.1, (500, 3)), np.zeros(3))
    kept = grid.gaussians(grid.find(first[:1]))
    assert kept.count[0] == 25  # one sweep may overfill it, none after
    np.testing.assert_allclose(kept.mean[0], first.mean(axis=0), atol=1e-12)


def test_far_voxels_are_forgotten_and_their_place_is_used_again() -> None:
    grid = VoxelGaussians(1.0, 20.0)
    for x in range(0, 3000, 5):
        around = np.array([x, 0, 0]) + RNG.uniform(-10, 10, (300, 3))
        grid.add(around, np.array([x, 0.0, 0.0]))
    assert (grid.find(around) >= 0).all()
    assert (grid.find(np.array([[x - 100.0, 0.0, 0.0]])) < 0).all()
    assert len(grid) < 40 * 22 * 22 and len(grid._count) < 16_384
    in_use = sorted(grid._slot.tolist())
    assert len(set(in_use)) == len(in_use)
    assert set(in_use).isdisjoint(grid._free)
    assert (np.diff(grid._keys) > 0).all()


def test_clear_forgets() -> None:
    grid = VoxelGaussians(1.0, 20.0)
    grid.add(RNG.uniform(0, 5, (100, 3)), np.zeros(3))
    grid.clear()
    assert len(grid) == 0 and (grid.find(np.ones((1, 3))) < 0).all()
