"""A broken link is found by what the loops across it would have it be."""

import numpy as np
from back_end_graphs import out_and_back

from lcd_common import se3
from lcd_loop_closure.broken_links import implied_links, moved, spanning, suspect_link
from lcd_loop_closure.pairwise_consistency import LoopMeasurements
from lcd_loop_closure.town_graphs import TownGraph


def measurements(drive: TownGraph) -> LoopMeasurements:
    ends = np.array([(loop.match_id, loop.query_id) for loop in drive.loops])
    T = np.array([loop.T_match_query for loop in drive.loops])
    return LoopMeasurements(ends, T, np.tile(np.eye(6), (len(ends), 1, 1)))


def test_spanning_counts_the_loops_over_each_link() -> None:
    ends = np.array([(0, 3), (2, 4), (4, 1)])
    brute = [sum(min(e) < row <= max(e) for e in ends) for row in range(6)]
    assert spanning(ends, 6).tolist() == brute


def test_every_loop_implies_the_true_link() -> None:
    drive = out_and_back()
    loops = measurements(drive)
    backwards = LoopMeasurements(
        loops.ends[:, ::-1], se3.inverse(loops.T_match_query), loops.covariances
    )
    broken = drive.with_broken_link(60, se3.rotation_z(1.0)).T_odom_base
    truth = se3.inverse(drive.T_world_base[59]) @ drive.T_world_base[60]
    for each in (loops, backwards):
        # A loop's error in turning moves what lies far from it.
        off = np.array([se3.distance(truth, T) for T in implied_links(broken, each, 60)])
        assert np.median(off[:, 0]) < 1.0 and np.median(off[:, 1]) < 0.02
        assert off[:, 0].max() < 4.0 and off[:, 1].max() < 0.05


def test_the_suspect_is_the_link_that_broke() -> None:
    drive = out_and_back().with_broken_link(60, se3.exp([0.4, 0.2, 0, 0, 0, 1.5]))
    none = np.zeros((0, 2), np.int64)
    arguments = drive.T_odom_base, drive.motions, measurements(drive)
    suspect = suspect_link(*arguments, none, minimum_loops=10, jump_m=5.0)
    assert suspect is not None and abs(suspect.row - 60) <= 2 and suspect.jump_m < 2.0
    after = moved(drive.T_odom_base, suspect.row, suspect.T_previous_this)
    np.testing.assert_array_equal(after[: suspect.row], drive.T_odom_base[: suspect.row])
    assert np.linalg.norm(after[-1, :3, 3] - drive.T_world_base[-1, :3, 3]) < 1.0
    assert suspect_link(*arguments, none, minimum_loops=99, jump_m=5.0) is None
    # Loops across it that odometry agrees with speak for the link.
    agreeing = np.tile([[50, 70]], (20, 1))
    elsewhere = suspect_link(*arguments, agreeing, minimum_loops=10, jump_m=5.0)
    assert elsewhere is None or not 50 < elsewhere.row <= 70


def test_a_far_jump_is_no_broken_link() -> None:
    drive = out_and_back().with_broken_link(60, se3.exp([80.0, 0, 0, 0, 0, 0]))
    none = np.zeros((0, 2), np.int64)
    assert (
        suspect_link(drive.T_odom_base, drive.motions, measurements(drive), none, 10, 5.0) is None
    )
