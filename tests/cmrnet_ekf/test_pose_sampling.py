"""The start errors that the documentation of CMRNet's protocol counts."""

import numpy as np
import pytest

from cmrnet_ekf import euler
from cmrnet_ekf.localization_errors import pose_errors, summary
from cmrnet_ekf.pose_sampling import STAGES, T_BODY_OPTICAL, targets
from lcd_common import se3


@pytest.mark.parametrize(
    ('stage', 't_median', 'r_median'), [(0, 1.88, 9.8), (1, 0.98, 1.97), (2, 0.59, 1.97)]
)
def test_guesses_are_as_far_off_as_cmrnets(stage, t_median, r_median):
    T = STAGES[stage].draw(np.random.default_rng(0), 20000)
    errors = summary(*pose_errors(np.broadcast_to(np.eye(4), T.shape), T))
    assert errors.t_median_m == pytest.approx(t_median, rel=0.02)
    assert errors.r_median_deg == pytest.approx(r_median, rel=0.02)
    assert errors.count == 20000


def test_the_first_stage_has_the_documented_means():
    T = STAGES[0].draw(np.random.default_rng(1), 20000)
    errors = summary(*pose_errors(np.broadcast_to(np.eye(4), T.shape), T))
    assert errors.t_mean_m == pytest.approx(1.83, abs=0.01)
    assert errors.r_mean_deg == pytest.approx(9.6, abs=0.05)
    assert T[:, 2, 3].min() >= -1.0 and T[:, 2, 3].max() > 1.9


def test_targets_lead_from_the_guess_back_to_the_camera():
    T_camera_guess = STAGES[0].draw(np.random.default_rng(2), 10)
    back = euler.transforms(targets(T_camera_guess))
    np.testing.assert_allclose(T_camera_guess @ back, np.broadcast_to(np.eye(4), (10, 4, 4)),
                               atol=1e-12)  # fmt: skip


def test_the_optical_axis_points_forward():
    np.testing.assert_array_equal(se3.transform_points(T_BODY_OPTICAL, np.array([[0.0, 0, 1]])),
                                  [[1, 0, 0]])  # fmt: skip
