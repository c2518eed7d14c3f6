"""Distances to surfaces have the derivatives they claim, and the right voxels count."""

import numpy as np

from lcd_common import se3
from lcd_loop_closure.surface_alignment import match_surfaces, polish
from lcd_loop_closure.voxel_gaussians import VoxelGaussians

RNG = np.random.default_rng(3)
NOISE = 0.02
PRIOR = np.diag([1.0] * 3 + [100.0] * 3)


def room(count: int) -> np.ndarray:
    """Points on the walls, the floor and two poles of a room, with 1 cm noise."""
    n = count // 5
    u, v = RNG.uniform(-9.5, 9.5, (2, 3, n))
    walls = [
        np.column_stack([np.full(n, 9.35), u[0], v[0]]),
        np.column_stack([u[1], np.full(n, -8.6), v[1]]),
        np.column_stack([u[2], v[2], np.full(n, -1.45)]),
    ]
    for x, y in ((3.4, 2.6), (-4.4, 5.3)):
        angle = RNG.uniform(0, 2 * np.pi, n)
        circle = 0.06 * np.column_stack([np.cos(angle), np.sin(angle)]) + [x, y]
        walls.append(np.column_stack([circle, RNG.uniform(-1.0, 4.0, n)]))
    return np.concatenate(walls) + RNG.normal(0.0, 0.01, (5 * n, 3))


def map_of_room() -> VoxelGaussians:
    surfaces = VoxelGaussians(1.0, 100.0)
    surfaces.add(room(30_000), np.zeros(3))
    return surfaces


def test_jacobians_are_those_of_finite_differences() -> None:
    surfaces, points = map_of_room(), room(500)
    T = se3.exp([0.02, -0.01, 0.01, 0.002, -0.001, 0.003])
    local = se3.transform_points(se3.inverse(T), points)
    matches = match_surfaces(local, T, surfaces, NOISE)
    assert len(matches.residual) > 300
    h = 1e-6
    for axis in range(6):
        xi = np.zeros(6)
        xi[axis] = h
        plus, minus = (
            match_surfaces(local, T @ se3.exp(s * xi), surfaces, NOISE) for s in (1.0, -1.0)
        )
        # No point may change its voxel on the way, or the rows are not the same.
        np.testing.assert_array_equal(plus.point, minus.point)
        numeric = (plus.residual - minus.residual) / (2 * h)
        np.testing.assert_allclose(matches.jacobian[:, axis], numeric, atol=1e-5)


def test_the_polish_finds_the_pose() -> None:
    surfaces, points = map_of_room(), room(1000)
    T_true = se3.exp([0.4, -0.3, 0.1, 0.02, -0.03, 0.3])
    local = se3.transform_points(se3.inverse(T_true), points)
    T_start = T_true @ se3.exp([0.1, -0.08, 0.05, 0.005, 0.004, -0.006])
    metres, radians = se3.distance(polish(local, T_start, surfaces, NOISE, PRIOR), T_true)
    assert metres < 0.005 and radians < 1e-3


def test_a_prior_keeps_what_no_surface_holds() -> None:
    surfaces = VoxelGaussians(1.0, 100.0)
    flat = np.column_stack([RNG.uniform(-20, 20, (40_000, 2)), RNG.normal(-1.5, 0.01, 40_000)])
    surfaces.add(flat, np.zeros(3))
    T_start = se3.exp([0.2, 0.3, 0.08, 0.0, 0.0, 0.02])
    T = polish(flat[:800], T_start, surfaces, NOISE, PRIOR)
    # The floor takes height, roll and pitch to zero; the rest stays where it was.
    np.testing.assert_allclose(se3.log(T)[[2, 3, 4]], 0.0, atol=2e-3)
    np.testing.assert_allclose(se3.log(T)[[0, 1, 5]], [0.2, 0.3, 0.02], atol=5e-3)


def test_planes_hold_along_their_normal_and_poles_in_both_directions() -> None:
    surfaces = map_of_room()
    wall = np.array([[9.35, 2.5, 1.5]])
    pole = np.array([[3.4, 2.6, 1.5]])
    at_wall = match_surfaces(wall, np.eye(4), surfaces, NOISE)
    assert len(at_wall.residual) == 1
    np.testing.assert_allclose(np.abs(at_wall.jacobian[0, :3]), [1, 0, 0], atol=0.05)
    at_pole = match_surfaces(pole, np.eye(4), surfaces, NOISE)
    assert len(at_pole.residual) == 2
    held = at_pole.jacobian[:, :3].T @ at_pole.jacobian[:, :3]
    np.testing.assert_allclose(held, np.diag([1, 1, 0]), atol=0.05)


def test_a_single_ring_on_the_ground_holds_nothing() -> None:
    """It looks like a pole that lies down, and it drives along with the scanner."""
    surfaces = VoxelGaussians(1.0, 100.0)
    angle = RNG.uniform(0, 2 * np.pi, 4000)
    ring = np.column_stack([12 * np.cos(angle), 12 * np.sin(angle), np.full(4000, -1.7)])
    surfaces.add(ring + RNG.normal(0, 0.01, ring.shape), np.zeros(3))
    matches = match_surfaces(ring[:300], np.eye(4), surfaces, NOISE)
    assert len(matches.residual) < 30  # where the ring crosses a corner of a voxel


def test_fitness_counts_points_on_surfaces() -> None:
    surfaces = map_of_room()
    on, off = room(600), RNG.uniform(30, 40, (600, 3))
    good = match_surfaces(on, np.eye(4), surfaces, NOISE).fitness
    mixed = match_surfaces(np.concatenate([on, off]), np.eye(4), surfaces, NOISE).fitness
    assert good > 0.9
    assert mixed == good * len(on) / (len(on) + len(off))
