"""Pairs, errors and intervals of registration against brute force and known answers."""

import numpy as np
import pytest
from evaluation_samples import World, out_and_back

from lcd_common import se3
from lcd_common.errors import DataError
from lcd_loop_closure.evaluation.proportion import Proportion
from lcd_loop_closure.evaluation.registration_errors import errors_of, joined_errors
from lcd_loop_closure.evaluation.registration_evaluation import evaluate_registration
from lcd_loop_closure.evaluation.registration_pairs import BANDS, Band, choose_pairs
from lcd_loop_closure.revisits import RevisitConfig, count_revisits

SETTINGS = RevisitConfig(first_scan=5, excluded_scans=8)


def test_pairs_are_all_of_a_band():
    poses = out_and_back(90.0)
    for band in BANDS:
        expected = [
            (j, i)
            for i in range(5, len(poses))
            for j in range(i - 8 + 1)
            if band.low_m < np.linalg.norm(poses[i, :3, 3] - poses[j, :3, 3]) <= band.high_m
        ]
        found = choose_pairs(poses, band, SETTINGS)
        assert list(zip(found.match, found.query, strict=True)) == expected
        assert found.total == len(found) > 20
        for k in (0, len(found) - 1):
            assert np.allclose(
                poses[found.match[k]] @ found.T_match_query[k], poses[found.query[k]]
            )
    assert choose_pairs(poses, BANDS[0], SETTINGS).reverse.all()
    assert len(choose_pairs(poses, BANDS[0])) == 0  # by the thesis's numbers the drive is too short


def test_the_first_band_has_the_pairs_that_are_counted(real_data):
    from lcd_common.trajectory import read_poses

    poses = read_poses(real_data / 'kitti_odometry' / 'poses_lidar_08.txt')
    pairs = choose_pairs(poses)
    assert len(pairs) == 2960 == count_revisits(poses).pairs


def test_a_draw_repeats_and_keeps_the_total():
    poses = out_and_back(90.0)
    band = Band(0.0, 10.0)
    drawn = choose_pairs(poses, band, SETTINGS, count=30, seed=1)
    again = choose_pairs(poses, band, SETTINGS, count=30, seed=1)
    other = choose_pairs(poses, band, SETTINGS, count=30, seed=2)
    assert len(drawn) == 30 and drawn.total == len(choose_pairs(poses, band, SETTINGS))
    assert np.array_equal(drawn.match, again.match) and np.array_equal(drawn.query, again.query)
    assert not np.array_equal(drawn.match, other.match)
    assert np.all(np.diff(drawn.query) >= 0)


def test_errors_are_those_that_were_put_in():
    true = np.array([se3.exp([1, 2, 0, 0, 0, 0.5])] * 5)
    tilted = true[0] @ se3.exp([0, 0, 0, np.radians(6.0), 0, 0])
    far = true[0].copy()
    far[0, 3] += 8.0
    answers = [
        true[0],
        true[0] @ se3.exp([1.5, 0, 0, 0, 0, np.radians(4.0)]),
        tilted,
        far,
        None,
    ]
    errors = errors_of(answers, true, 1.0, 2.0)
    assert errors.te_m[:4] == pytest.approx([0.0, 1.5, 0.0, 8.0], abs=2e-3)
    assert errors.re_deg[:4] == pytest.approx([0.0, 4.0, 6.0, 0.0], abs=1e-6)
    assert errors.yaw_deg[1] == pytest.approx(4.0) and errors.yaw_deg[2] < 1e-6
    assert list(errors.success) == [True, True, True, False, False]
    assert list(errors.success_full) == [True, True, False, False, False]
    plain = errors.plain()
    assert (plain['pairs'], plain['answered']) == (5, 4)
    assert plain['success'] == pytest.approx(0.6) and plain['success_full'] == pytest.approx(0.4)
    assert plain['te_m'] == pytest.approx(0.75, abs=2e-3)
    assert plain['te_m_all'] == pytest.approx(np.nanmean(errors.te_m))
    assert plain['te_m_median_all'] == pytest.approx(np.nanmedian(errors.te_m))
    joined = joined_errors([errors, errors.select(np.array([True, False, False, False, False]))])
    assert len(joined) == 6 and joined.plain()['success'] == pytest.approx(4 / 6)


def test_headings_wrap_round():
    errors = errors_of([se3.rotation_z(np.pi - 0.01)], se3.rotation_z(-np.pi + 0.01)[None])
    assert errors.yaw_deg[0] == pytest.approx(np.degrees(0.02))


def test_a_method_that_tells_heading_alone_is_judged_by_that():
    true = np.array([se3.exp([3, 0, 0, 0, 0, 1.0])])
    errors = errors_of([se3.rotation_z(1.02)], true, yaw_only=True)
    plain = errors.plain()
    assert plain['success'] == 1.0 and 'te_m' not in plain
    assert plain['yaw_deg'] == pytest.approx(np.degrees(0.02))


def test_nothing_to_sum_up():
    plain = errors_of([None, None], np.tile(np.eye(4), (2, 1, 1))).plain()
    assert plain['success'] == 0.0 and plain['te_m'] is None and plain['re_deg_all'] is None
    assert errors_of([], np.empty((0, 4, 4))).plain()['success'] is None


@pytest.mark.parametrize(
    ('successes', 'trials', 'interval'),
    # Newcombe, Statistics in Medicine 1998, Table I, method 3.
    [
        (81, 263, (0.2553, 0.3662)),
        (15, 148, (0.0624, 0.1605)),
        (0, 20, (0.0, 0.1611)),
        (1, 29, (0.0061, 0.1718)),
    ],
)
def test_wilson_intervals_are_those_published(successes, trials, interval):
    found = Proportion(successes, trials)
    assert found.interval == pytest.approx(interval, abs=5e-5)
    assert found.share == successes / trials


def test_no_trials_have_no_interval():
    assert Proportion(0, 0).share is None and Proportion(0, 0).interval is None


class Oracle:
    """Answers with the truth, except for one scan that it cannot read."""

    name = 'oracle'

    def __init__(self, world: World) -> None:
        self.world, self.prepared = world, []

    def prepare(self, cloud):
        number = next(
            k
            for k in range(len(self.world.T_world_base))
            if len(self.world.cloud(k)) == len(cloud)
            and np.array_equal(self.world.cloud(k).xyz[:3], cloud.xyz[:3])
        )
        self.prepared.append(number)
        if number == 0:
            raise DataError('too few points')
        return self.world.T_world_base[number]

    def register(self, match, query):
        return se3.inverse(match) @ query


def test_each_cloud_is_prepared_once_and_failures_have_no_answer():
    world = World(out_and_back(30.0))
    pairs = choose_pairs(world.T_world_base, Band(0.0, 10.0), SETTINGS)
    oracle, steps = Oracle(world), []
    errors, answers = evaluate_registration(
        oracle, world.cloud, pairs, progress=lambda: steps.append(1)
    )
    unread = pairs.match == 0
    assert unread.any() and not unread.all()
    assert [answer is None for answer in answers] == list(unread)
    assert errors.te_m[~unread].max() < 1e-9
    assert len(steps) == len(pairs)
    read = [number for number in oracle.prepared if number]
    assert len(read) == len(set(read))
    assert errors.register_ms is not None and errors.prepare_ms is not None
