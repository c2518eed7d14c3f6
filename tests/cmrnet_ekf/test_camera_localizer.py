"""Check frames and covariances with a predictor that knows the answer."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from camera_scenes import camera, street

from cmrnet_ekf import euler
from cmrnet_ekf.camera_localizer import CameraLocalizer, base_covariance
from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.config import COMPACT
from cmrnet_ekf.pose_belief import PoseBelief
from cmrnet_ekf.pose_sampling import T_OPTICAL_BODY, NoiseRange
from cmrnet_ekf.predictors import Predictor
from lcd_common import se3
from lcd_common.errors import ConfigError

SETTINGS = replace(
    COMPACT, width=96, height=48, focal=0.0, centred=False, pyramid=(4, 6, 8), estimator=(8,),
    hidden=16, branch=8, squeezed=4, pooled_rows=2, pooled_columns=4,
)  # fmt: skip
T_BASE_CAMERA = se3.from_rotation_translation(
    se3.so3_exp([0.02, -0.1, 0.3]) @ se3.inverse(T_OPTICAL_BODY)[:3, :3], [1.1, 0.2, 1.6]
)


class Told(Predictor):
    """Answers a fixed correction, and remembers what it was shown."""

    def __init__(self, T_guess_camera, settings=SETTINGS):
        super().__init__([Cmrnet(settings)])
        self.answer, self.shown = euler.components(T_guess_camera)[None], []

    def belief(self, image, lidar):
        self.shown.append((image, lidar))
        scale = np.full((1, 6), 0.1)
        return PoseBelief(self.answer, scale, np.full((1, 6), np.inf), np.square(scale))


def test_corrections_are_applied_at_the_camera_one_after_the_other():
    corrections = [se3.exp([0.5, -0.2, 0.1, 0.02, 0.01, -0.1]), se3.exp([0.1, 0, 0, 0, 0, 0.05])]
    stages = [Told(T) for T in corrections]
    localizer = CameraLocalizer(camera(), T_BASE_CAMERA, stages)
    T_map_guess = se3.exp([3, 1, 0, 0, 0, 0.4])
    points = street(np.random.default_rng(0))
    pixels = np.zeros((48, 96, 3), np.uint8)
    estimate = localizer.locate(pixels, points, T_map_guess)

    T_base_body = T_BASE_CAMERA @ T_OPTICAL_BODY
    T_map_body = T_map_guess @ T_base_body @ corrections[0] @ corrections[1]
    np.testing.assert_allclose(
        estimate.T_map_base, T_map_body @ se3.inverse(T_base_body), atol=1e-9
    )
    # The second stage looks from where the first one put the camera.
    T_map_second = T_map_guess @ T_base_body @ corrections[0] @ se3.inverse(T_OPTICAL_BODY)
    expected = localizer._imagers[1].image(points, se3.inverse(T_map_second))
    assert torch.equal(stages[1].shown[0][1][0], expected)
    assert torch.equal(estimate.lidar, expected)
    assert estimate.fill == pytest.approx(float((expected > 0).float().mean()))


def test_a_sure_guess_is_refined_by_the_last_network_alone():
    T = se3.exp([0.1, 0, 0, 0, 0, 0.01])
    stages = [Told(T) for _ in range(3)]
    stages[1].trained_for, stages[2].trained_for = NoiseRange(1.0, 0.035), NoiseRange(0.6, 0.035)
    localizer = CameraLocalizer(camera(), T_BASE_CAMERA, stages)
    C = np.diag([0.25**2] * 3 + [0.01**2] * 3)
    assert localizer.first_stage(C) == 2
    C[0, 0] = 0.45**2
    assert localizer.first_stage(C) == 1
    C[0, 0] = C[1, 1] = 0.4**2
    C[0, 1] = C[1, 0] = 0.15
    assert localizer.first_stage(C) == 0, 'the deviation along the diagonal is 0.55 m'
    assert localizer.first_stage(np.diag([0.1**2] * 3 + [0.02**2] * 3)) == 0
    stages[1].trained_for = None
    assert localizer.first_stage(np.diag([0.4**2] * 3 + [0.01**2] * 3)) == 0
    points = street(np.random.default_rng(0))
    localizer.locate(np.zeros((48, 96, 3), np.uint8), points, np.eye(4), first=2)
    assert [len(one.shown) for one in stages] == [0, 0, 1]


def test_the_covariance_is_that_of_drawn_poses():
    rng = np.random.default_rng(1)
    mean = np.array([[0.4, -0.3, 0.1, 0.05, -0.1, 0.15]])
    scale = np.array([[0.2, 0.1, 0.05, 0.01, 0.02, 0.03]])
    belief = PoseBelief(mean, scale, np.full((1, 6), np.inf), scale**2)
    T_body_base = se3.inverse(T_BASE_CAMERA @ T_OPTICAL_BODY)
    draws = euler.transforms(mean + rng.normal(size=(20000, 6)) * scale) @ T_body_base
    T_mean = euler.transforms(mean[0]) @ T_body_base
    xi = np.array([se3.log(se3.inverse(T_mean) @ T) for T in draws])
    found = base_covariance(belief, T_body_base)
    sampled = np.cov(xi.T)
    deviation = np.sqrt(np.diag(sampled))
    np.testing.assert_allclose(
        found / np.outer(deviation, deviation), sampled / np.outer(deviation, deviation), atol=0.04
    )


def test_an_infinite_variance_stays_infinite():
    one = np.ones((1, 6))
    belief = PoseBelief(0 * one, one, 2 * one, one)
    assert np.isinf(base_covariance(belief, np.eye(4))).all()


def test_stages_must_fit():
    with pytest.raises(ConfigError, match='at least one'):
        CameraLocalizer(camera(), T_BASE_CAMERA, [])
    with pytest.raises(ConfigError, match='same images'):
        CameraLocalizer(
            camera(),
            T_BASE_CAMERA,
            [Told(np.eye(4)), Told(np.eye(4), replace(SETTINGS, width=128))],
        )
