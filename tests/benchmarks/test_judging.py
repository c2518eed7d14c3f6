"""Links that odometry broke are told from those that the pose graph gave up."""

from collections.abc import Collection

import numpy as np
import pytest

from benchmarks.judging import link_figures
from lcd_common import se3
from lcd_common.trajectory import Trajectory
from lcd_loop_closure.report.result import DriveResult

STAMPS = np.arange(20, dtype=np.int64) * 10**9
STEP = se3.exp(np.array([3.0, 0, 0, 0, 0, 0.1]))


def _drive(broken: dict[int, list[float]]) -> DriveResult:
    """Return a drive of 20 keyframes; the odometry of some links is off by a twist."""
    truth, odometry = [np.eye(4)], [se3.exp(np.array([5.0, 1, 0, 0, 0, 2]))]
    for row in range(1, len(STAMPS)):
        truth.append(truth[-1] @ STEP)
        odometry.append(odometry[-1] @ STEP @ se3.exp(np.array(broken.get(row, [0.0] * 6))))
    poses = Trajectory(STAMPS, np.array(odometry))
    return DriveResult('a', 'b', poses, poses, truth=Trajectory(STAMPS, np.array(truth)))


TURNED, SHIFTED, FINE = [0, 0, 0, 0, 0, 3.0], [1.5, 0, 0, 0, 0, 0], [0.5, 0, 0, 0, 0, 0.02]


@pytest.mark.parametrize(
    ('given_up', 'noticed', 'exactly', 'wrongly'),
    [((), 0, 0, 0), ((7,), 1, 1, 0), ((6,), 1, 0, 0), ((5,), 0, 0, 1), ((8, 14, 2), 2, 1, 1)],
)
def test_links_are_counted(
    given_up: Collection[int], noticed: int, exactly: int, wrongly: int
) -> None:
    figures = link_figures(_drive({3: FINE, 7: TURNED, 14: SHIFTED}), given_up)
    assert figures == {
        'links_broken': 2,
        'links_noticed': noticed,
        'links_noticed_exactly': exactly,
        'links_wrongly_given_up': wrongly,
    }
