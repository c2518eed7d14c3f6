import numpy as np
import pytest
from scipy.spatial import cKDTree
from simulated_street import pairs_apart, relative, view

from lcd_common import se3
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.refinement import Refinement
from lcd_loop_closure.verification import RangeView, Verification, VerificationConfig

ORIGIN = np.array([0.0, 0.0, 1.73])


def check(match_xyz, query_xyz, T_match_query, settings=None):
    refinement, verification = Refinement(), Verification(settings)
    return verification.check(
        refinement.surface(match_xyz),
        refinement.surface(query_xyz),
        verification.range_view(match_xyz),
        verification.range_view(query_xyz),
        T_match_query,
    )


def test_shares_are_those_of_a_brute_force_search():
    i, j = pairs_apart(4, 8)[40]
    match, query = view(i), view(j)
    T = relative(match, query)
    verdict = check(match.reduced.xyz, query.reduced.xyz, T)

    def distances(from_xyz, to_xyz, T_to_from):
        above = from_xyz[from_xyz[:, 2] > 0.5].astype(np.float64)
        return cKDTree(to_xyz).query(se3.transform_points(T_to_from, above))[0]

    there = distances(query.reduced.xyz, match.reduced.xyz, T)
    back = distances(match.reduced.xyz, query.reduced.xyz, se3.inverse(T))
    assert verdict.status is LoopStatus.ACCEPTED
    assert verdict.fitness == pytest.approx(np.mean(there < 0.4), abs=1e-3)
    assert verdict.overlap == pytest.approx(
        min(np.mean(there < 0.4), np.mean(back < 0.4)), abs=1e-3
    )
    assert verdict.inliers == pytest.approx(np.sum(there < 0.4), abs=3)
    assert verdict.rmse_m == pytest.approx(np.sqrt(np.mean(there[there < 0.4] ** 2)), abs=1e-3)
    assert verdict.violations < 0.02


def wall(distance_m, z=(0.0, 4.0), width_m=10.0):
    y, z_grid = np.meshgrid(np.arange(-width_m, width_m, 0.2), np.arange(*z, 0.2))
    return np.column_stack([np.full(y.size, distance_m), y.ravel(), z_grid.ravel()])


def test_points_before_a_wall_contradict_it_and_points_behind_do_not():
    seen = RangeView(wall(20.0), ORIGIN)
    before, behind = wall(10.0, width_m=4.0), wall(30.0, width_m=4.0)
    nearly, beside = wall(19.5, width_m=4.0), wall(10.0) + np.array([0.0, 100.0, 0.0])
    gone, in_view = seen.violations(before, 1.0)
    # Upper rows look over the wall from so near: those directions were never seen.
    assert gone == in_view and gone > 0.5 * len(before)
    for xyz in (behind, nearly):
        assert seen.violations(xyz, 1.0)[0] == 0
    assert seen.violations(beside, 1.0) == (0, 0)


def test_the_view_wraps_around_behind_the_vehicle():
    seen = RangeView(wall(-20.0), ORIGIN)
    gone, in_view = seen.violations(wall(-10.0, z=(1.0, 2.5), width_m=3.0), 1.0)
    assert gone == in_view > 100


@pytest.mark.parametrize(
    ('change', 'status', 'said'),
    [
        (se3.exp([0, 0, 0, 0.2, 0, 0]), LoopStatus.REJECTED_REGISTRATION, 'roll and pitch of 11.5'),
        (se3.exp([0, 0, 2.5, 0, 0, 0]), LoopStatus.REJECTED_REGISTRATION, 'height difference 2.50'),
        (se3.exp([21, 0, 0, 0, 0, 0]), LoopStatus.REJECTED_REGISTRATION, 'distance 21.0 m exceeds'),
        (se3.exp([4, 1, 0, 0, 0, 1]), LoopStatus.REJECTED_FITNESS, 'is below 0.3'),
    ],
)
def test_rejections_say_value_and_limit(change, status, said):
    xyz = view(100).reduced.xyz
    verdict = check(xyz, xyz, change)
    assert verdict.status is status
    assert said in verdict.reason


def test_a_query_that_covers_a_part_of_the_match_lacks_overlap():
    xyz = view(100).reduced.xyz
    part = xyz[(xyz[:, 1] > 0) & (np.hypot(xyz[:, 0], xyz[:, 1]) < 12)]
    verdict = check(xyz, part, np.eye(4), VerificationConfig(min_structure=50))
    assert verdict.fitness == 1.0
    assert verdict.status is LoopStatus.REJECTED_OVERLAP
    assert f'overlap {verdict.overlap:.2f} is below 0.25' in verdict.reason


def test_structure_in_seen_empty_space_is_rejected():
    xyz = view(100).reduced.xyz.astype(np.float64)
    shrunk = xyz * [0.6, 0.6, 1.0]
    settings = VerificationConfig(min_fitness=0.0, min_overlap=0.0)
    verdict = check(xyz, shrunk, np.eye(4), settings)
    assert verdict.status is LoopStatus.REJECTED_OVERLAP
    assert 'seen empty' in verdict.reason


def test_an_open_field_cannot_decide():
    flat = np.random.default_rng(0).uniform(-40, 40, (3000, 3)) * [1, 1, 0.001]
    verdict = check(flat, flat, np.eye(4))
    assert verdict.status is LoopStatus.REJECTED_REGISTRATION
    assert 'points above the ground, at least 200 are needed' in verdict.reason
