"""The covariance is that of the errors: in analytic worlds, and counted in simulated drives."""

from collections.abc import Callable

import numpy as np
import pytest
from odometry_drives import drive, follow, motion_error, span_ratios, step_ratios

from lcd_common import se3
from lcd_loop_closure.odometry_covariance import (
    MotionCovariance,
    lost_covariance,
    motion_covariance,
)
from lcd_loop_closure.surface_alignment import match_surfaces, polish
from lcd_loop_closure.voxel_gaussians import VoxelGaussians

NOISE = 0.02
PRIOR = np.diag([1.0] * 3 + [400.0] * 3)  # 1 m, 0.05 rad
World = Callable[[np.random.Generator, int], np.ndarray]


def ground(rng: np.random.Generator, count: int) -> np.ndarray:
    return np.column_stack([rng.uniform(-30, 30, (count, 2)), np.full(count, -1.7)])


def wall_along_x(rng: np.random.Generator, count: int, y: float) -> np.ndarray:
    return np.column_stack(
        [rng.uniform(-30, 30, count), np.full(count, y), rng.uniform(-1.7, 5, count)]
    )


def field(rng: np.random.Generator, count: int) -> np.ndarray:
    return ground(rng, count)


def corridor(rng: np.random.Generator, count: int) -> np.ndarray:
    n = count // 3
    return np.concatenate([ground(rng, n), wall_along_x(rng, n, 4.3), wall_along_x(rng, n, -5.6)])


def yard(rng: np.random.Generator, count: int) -> np.ndarray:
    across = wall_along_x(rng, count // 4, 20.4)[:, [1, 0, 2]]
    return np.concatenate([corridor(rng, 3 * count // 4), across])


def noisy(xyz: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Add noise along the beams, as a scanner at the origin does."""
    ranges = np.linalg.norm(xyz, axis=1, keepdims=True)
    return xyz * (1.0 + rng.normal(0.0, NOISE, (len(xyz), 1)) / ranges)


def registered(
    world: World, seed: int, count: int = 1000
) -> tuple[se3.Array, MotionCovariance, float]:
    """Polish a sweep on a map of the same world; return its pose error, covariance and fitness."""
    rng = np.random.default_rng(seed)
    surfaces = VoxelGaussians(1.0, 100.0)
    for _ in range(3):
        surfaces.add(noisy(world(rng, 20_000), rng), np.zeros(3))
    T_true = se3.exp([0.3, -0.2, 0.05, 0.004, -0.006, 0.02])
    points = se3.transform_points(se3.inverse(T_true), noisy(world(rng, count), rng))
    T_start = T_true @ se3.exp(rng.normal(0, [0.02, 0.02, 0.02, 0.002, 0.002, 0.002]))
    T = polish(points, T_start, surfaces, NOISE, PRIOR)
    matches = match_surfaces(points, T, surfaces, NOISE)
    covariance = motion_covariance(matches, points, PRIOR, cell_size=4.0, renewed=1.0)
    return se3.log(se3.inverse(T) @ T_true), covariance, matches.fitness


def test_the_errors_of_many_registrations_have_the_covariance() -> None:
    """A pose against the map has half the covariance of a motion, which lies between two poses."""
    ratios, squares, variances = [], [], []
    for seed in range(40):
        error, covariance, _ = registered(yard, seed)
        ratios.append(error @ np.linalg.solve(0.5 * covariance.step, error) / 6.0)
        squares.append(error**2)
        variances.append(np.diag(0.5 * covariance.step))
    assert 1 / 3 < np.mean(ratios) < 3.0
    by_axis = np.mean(squares, axis=0) / np.mean(variances, axis=0)
    assert np.all((by_axis > 0.2) & (by_axis < 3.0))


def test_a_corridor_leaves_the_way_along_it_unknown() -> None:
    _, covariance, _ = registered(corridor, 0)
    sigma = np.sqrt(np.diag(covariance.step))
    assert sigma[0] > 0.9  # the prior's metre, nearly
    assert sigma[1:3].max() < 0.05 and sigma[3:].max() < 2e-3
    _, closed, _ = registered(yard, 0)
    assert np.sqrt(closed.step[0, 0]) < 0.02


def test_an_open_field_leaves_position_and_heading_unknown() -> None:
    _, covariance, _ = registered(field, 0)
    sigma = np.sqrt(np.diag(covariance.step))
    assert sigma[:2].min() > 0.5 and sigma[5] > 0.02
    assert sigma[2] < 0.01 and sigma[3:5].max() < 2e-3


def test_without_any_matches_the_prior_is_all() -> None:
    points = np.random.default_rng(0).uniform(-5, 5, (50, 3))
    matches = match_surfaces(points, np.eye(4), VoxelGaussians(1.0, 100.0), NOISE)
    assert matches.fitness == 0.0 and len(matches.residual) == 0
    covariance = motion_covariance(matches, points, PRIOR, cell_size=4.0, renewed=1.0)
    np.testing.assert_allclose(covariance.step, np.linalg.inv(PRIOR))
    np.testing.assert_array_equal(polish(points, np.eye(4), VoxelGaussians(1.0, 9.0), 0.1, PRIOR),
                                  np.eye(4))  # fmt: skip


def test_the_covariance_follows_the_residuals() -> None:
    """Errors that whole patches of the map share count more than noise of the same size."""
    rng = np.random.default_rng(1)
    surfaces = VoxelGaussians(1.0, 100.0)
    surfaces.add(noisy(yard(rng, 60_000), rng), np.zeros(3))
    points = noisy(yard(rng, 1000), rng)
    plain = motion_covariance(
        match_surfaces(points, np.eye(4), surfaces, NOISE), points, PRIOR,
        cell_size=4.0, renewed=1.0,
    )  # fmt: skip
    patch = np.floor(points / 4.0).astype(int)
    _, patch = np.unique(patch, axis=0, return_inverse=True)
    shifts = rng.normal(0.0, 0.02, (patch.max() + 1, 3))[patch.ravel()]
    bent = points + shifts
    shared = motion_covariance(
        match_surfaces(bent, np.eye(4), surfaces, NOISE), bent, PRIOR, cell_size=4.0, renewed=1.0
    )
    assert np.all(np.diag(shared.step)[:3] > 4.0 * np.diag(plain.step)[:3])


def test_who_stands_adds_little_to_the_chain() -> None:
    rng = np.random.default_rng(2)
    surfaces = VoxelGaussians(1.0, 100.0)
    surfaces.add(noisy(yard(rng, 60_000), rng), np.zeros(3))
    points = noisy(yard(rng, 1000), rng)
    matches = match_surfaces(points, np.eye(4), surfaces, NOISE)
    standing, driving = (
        motion_covariance(matches, points, PRIOR, cell_size=4.0, renewed=r) for r in (0.0, 1.0)
    )
    assert np.all(np.diag(standing.growth) < np.diag(driving.growth))
    for one in (standing, driving):
        assert se3.is_covariance(one.step) and se3.is_covariance(one.growth)
        assert np.all(np.diag(one.growth) <= np.diag(one.step))


def test_a_lost_motion_is_as_unsure_as_it_is_told() -> None:
    lost = lost_covariance(2.0, 1.5)
    np.testing.assert_allclose(np.sqrt(np.diag(lost.step)), [2, 2, 2, 0.15, 0.15, 1.5])


@pytest.mark.parametrize(
    ('route', 'seed', 'indices', 'timed', 'polished'),
    [
        ('corner', 20, tuple(range(10, 56)), False, True),
        ('corner', 20, tuple(range(10, 56)), False, False),
        ('corner', 21, tuple(range(10, 56)), True, True),
        ('corner', 21, tuple(range(10, 56)), True, False),
        # KISS-ICP alone does not notice that a vehicle sets off so slowly.
        ('creep', 22, tuple(range(10, 50)), False, True),
    ],
)
def test_relative_poses_have_the_errors_that_they_are_said_to_have(
    route: str, seed: int, indices: tuple[int, ...], timed: bool, polished: bool
) -> None:
    """The normalised error squared, from sweep to sweep and between keyframes, within three."""
    samples = drive(route, seed, indices, timed)
    _, estimates = follow(samples, polish=polished)
    assert all(e.healthy for e in estimates)
    assert 1 / 3 < step_ratios(samples, estimates, skip=3).mean() < 3.0
    ratios = span_ratios(samples, estimates, 2.0, skip=3)
    assert len(ratios) >= 10
    assert 1 / 3 < ratios.mean() < 3.0


def test_setting_off_slowly_is_noticed() -> None:
    """Point to point, a scanner's own rings on the ground hold it where it stands."""
    samples = drive('creep', 22, tuple(range(10, 50)))
    _, estimates = follow(samples)
    error = motion_error(samples, estimates, 0, len(samples) - 1)
    assert np.linalg.norm(error[:3]) < 0.05  # of 5.9 m
