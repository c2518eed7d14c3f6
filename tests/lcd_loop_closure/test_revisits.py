import numpy as np
import pytest

from lcd_common import se3
from lcd_common.trajectory import read_poses
from lcd_loop_closure.revisits import RevisitConfig, count_revisits, true_loops


def random_walk(seed, count=220):
    rng = np.random.default_rng(seed)
    T, forward = [np.eye(4)], se3.exp([1.0, 0, 0, 0, 0, 0])
    for _ in range(count - 1):
        T.append(T[-1] @ se3.exp([0, 0, 0, 0, 0, 0.1 + rng.normal(0, 0.4)]) @ forward)
    return np.array(T)


@pytest.mark.parametrize('seed', range(4))
def test_counts_are_those_of_two_nested_loops(seed):
    T = random_walk(seed)
    s = RevisitConfig(distance=3.0, excluded_scans=20, first_scan=30)
    loops = pairs = reverse = 0
    partners = [[] for _ in T]
    for i in range(len(T)):
        for j in range(len(T)):
            metres, radians = se3.distance(T[i], T[j])
            if i >= 30 and j <= i - 20 and metres <= 3.0:
                partners[i].append((metres, j))
                pairs += 1
                reverse += radians > s.reverse_angle
        loops += bool(partners[i])
    counted = count_revisits(T, s)
    assert (counted.scans, counted.loops, counted.pairs) == (len(T), loops, pairs)
    assert counted.reverse_share == pytest.approx(reverse / pairs)
    assert counted.length_m == pytest.approx(len(T) - 1)
    found = true_loops(T[:, :3, 3], s)
    assert [list(row) for row in found] == [[j for _, j in sorted(row)] for row in partners]


@pytest.mark.parametrize(
    ('file', 'loops', 'pairs', 'reverse'),
    [('poses_lidar_08.txt', 334, 2960, 1.0), ('poses/08.txt', 265, 1962, 1.0),
     ('poses/00.txt', 791, 10_211, None)],
)  # fmt: skip
def test_published_counts(real_data, file, loops, pairs, reverse):
    counted = count_revisits(read_poses(real_data / 'kitti_odometry' / file))
    assert (counted.loops, counted.pairs) == (loops, pairs)
    assert reverse is None or counted.reverse_share == reverse


@pytest.mark.parametrize('count', [0, 1, 99])
def test_short_trajectories_have_no_revisits(count):
    counted = count_revisits(np.tile(np.eye(4), (count, 1, 1)))
    assert (counted.scans, counted.loops, counted.pairs) == (count, 0, 0)
    assert counted.reverse_share is None
