import numpy as np
import pytest
from scipy.spatial import cKDTree
from simulated_street import pairs_apart, relative, view

from lcd_common import se3
from lcd_loop_closure.refinement import Refinement, RefinementConfig

WITHOUT_MODEL_ERROR = RefinementConfig(model_sigma=1e-3)


def refined_pair(refinement, i, j, guess_error):
    match, query = view(i), view(j)
    surfaces = refinement.surface(match.reduced.xyz), refinement.surface(query.reduced.xyz)
    T_true = relative(match, query)
    near = refinement.approach(*surfaces, T_true @ se3.exp(guess_error))
    return surfaces, T_true, refinement.refine(*surfaces, near)


def sandwich_by_finite_differences(match, query, T, settings):
    """The same covariance from its definition: numeric Jacobian, one patch after the other."""
    moved = se3.transform_points(T, query.xyz)
    distance, index = cKDTree(match.xyz).query(moved)
    near = np.flatnonzero(distance < settings.gate)
    covs_match = np.asarray(match.points.covs())[index[near], :3, :3]
    covs_query = np.asarray(query.points.covs())[near, :3, :3]
    R = T[:3, :3]
    weight = np.linalg.inv(covs_match + R @ covs_query @ R.T)

    def residual(xi):
        return match.xyz[index[near]] - se3.transform_points(T @ se3.exp(xi), query.xyz[near])

    step = 1e-6
    columns = [(residual(step * e) - residual(-step * e)) / (2 * step) for e in np.eye(6)]
    jacobian = np.stack(columns, axis=-1)
    H = np.einsum('nia,nij,njb->ab', jacobian, weight, jacobian)
    gradient = np.einsum('nia,nij,nj->na', jacobian, weight, residual(np.zeros(6)))
    B = np.zeros((6, 6))
    patches = [tuple(c) for c in np.floor(moved[near] / settings.patch).astype(int)]
    for patch in set(patches):
        g = gradient[[p == patch for p in patches]].sum(axis=0)
        B += np.outer(g, g)
    return np.linalg.inv(H) @ B @ np.linalg.inv(H)


@pytest.mark.parametrize('sign', [-1.0, 1.0])
def test_a_rough_guess_becomes_exact(sign):
    i, j = pairs_apart(2, 4)[300]
    error = sign * np.array([0.8, -0.6, 0.3, 0.02, -0.02, 0.06])
    _, T_true, refined = refined_pair(Refinement(), i, j, error)
    metres, radians = se3.distance(T_true, refined.T_match_query)
    assert refined.converged
    assert metres < 0.02 and np.degrees(radians) < 0.05


def test_covariance_is_that_of_its_definition():
    settings = RefinementConfig(model_sigma=1e-4)
    refinement = Refinement(settings)
    i, j = pairs_apart(0.5, 2)[50]
    (match, query), _, refined = refined_pair(refinement, i, j, np.full(6, 0.01))
    found = refinement.covariance(match, query, refined.T_match_query)
    expected = sandwich_by_finite_differences(match, query, refined.T_match_query, settings)
    np.testing.assert_allclose(
        np.sqrt(np.diag(found)),
        np.sqrt(np.diag(expected) + np.array([1e-8] * 3 + [0] * 3)),
        rtol=0.1,
    )
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.1)


def test_covariance_is_consistent_in_simulation():
    refinement = Refinement(WITHOUT_MODEL_ERROR)
    rng = np.random.default_rng(1)
    pairs = pairs_apart(0.5, 8)
    nees = []
    for at in np.linspace(0, len(pairs) - 1, 16).astype(int):
        guess = rng.normal(size=6) * [0.2, 0.2, 0.1, 0.01, 0.01, 0.02]
        surfaces, T_true, refined = refined_pair(refinement, *pairs[at], guess)
        covariance = refinement.covariance(*surfaces, refined.T_match_query)
        assert covariance is not None and se3.is_covariance(covariance)
        error = se3.log(se3.inverse(refined.T_match_query) @ T_true)
        nees.append(error @ np.linalg.solve(covariance, error))
    assert 6.0 / 3.0 < np.mean(nees) < 6.0 * 3.0


def test_model_error_is_added():
    i, j = pairs_apart(0.5, 2)[50]
    (match, query), _, refined = refined_pair(Refinement(), i, j, np.zeros(6))
    covariance = Refinement().covariance(match, query, refined.T_match_query)
    assert np.all(np.sqrt(np.diag(covariance)[:3]) > 0.02)
    assert np.all(np.sqrt(np.diag(covariance)[:3]) < 0.03)


def test_the_same_clouds_give_the_same_pose():
    i, j = pairs_apart(2, 4)[7]
    poses = [refined_pair(Refinement(), i, j, np.full(6, 0.02))[2].T_match_query for _ in range(2)]
    assert np.array_equal(*poses)


def test_clouds_without_partners_have_no_covariance():
    refinement = Refinement()
    xyz = view(0).reduced.xyz
    surface, far = refinement.surface(xyz), refinement.surface(xyz + np.float32(500))
    assert refinement.covariance(surface, far, np.eye(4)) is None
