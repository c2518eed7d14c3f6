"""Compare varied samples with what a camera would see of a street varied in the same way."""

from dataclasses import replace

import numpy as np
import torch
from small_samples import CAMERA, SMALL

from cmrnet_ekf import euler
from cmrnet_ekf.camera_localizer import framing_of, imager_of
from cmrnet_ekf.pose_sampling import T_OPTICAL_BODY, targets
from cmrnet_ekf.training.augmentation import augmented, mirrored, rolled
from cmrnet_ekf.training.batch import Batch
from lcd_common import se3


def test_a_mirrored_sample_is_what_is_seen_of_the_mirrored_street():
    """Project a mirrored cloud from the mirrored guess: the image and the target must agree."""
    rng = np.random.default_rng(0)
    camera = framing_of(CAMERA, SMALL).camera
    points = rng.uniform([4, -10, -1.6], [40, 10, 4], (20000, 3)).astype(np.float32)
    T_camera_guess = euler.transforms([0.5, -1.0, 0.2, 0.1, -0.05, 0.15])
    lidar = imager_of(camera, SMALL).image(points, T_OPTICAL_BODY @ se3.inverse(T_camera_guess))
    target = torch.from_numpy(targets(T_camera_guess[None])).float()
    batch = Batch(torch.zeros(1, 3, 32, 64), lidar[None], target, torch.ones(1, 4))
    flipped = mirrored(batch, torch.tensor([True]))

    M = np.diag([1.0, -1.0, 1.0, 1.0])
    K = camera.K.copy()
    K[0, 2] = camera.width - 1 - K[0, 2]
    T_mirrored = M @ T_camera_guess @ M
    expected = imager_of(replace(camera, K=K), SMALL).image(
        points * [1, -1, 1], T_OPTICAL_BODY @ se3.inverse(T_mirrored)
    )
    different = (flipped.lidar[0] - expected).abs() > 1e-3
    assert different.float().mean() < 0.01, 'but for points on the borders of pixels'
    np.testing.assert_allclose(flipped.target, targets(T_mirrored[None]), atol=1e-6)
    assert torch.equal(mirrored(batch, torch.tensor([False])).lidar, batch.lidar)


def test_a_rolled_sample_is_what_a_rolled_camera_sees():
    """Project the street from the rolled guess: the image and the target must agree."""
    rng = np.random.default_rng(1)
    camera = framing_of(CAMERA, SMALL).camera
    # A wall far away and the ground: surfaces, so that neighbouring pixels agree.
    wall = np.stack(np.broadcast_arrays(30.0, *rng.uniform(-15, 15, (2, 60000))), 1)
    ground = np.stack([*rng.uniform([[4], [-15]], [[30], [15]], (2, 60000)), np.full(60000, -1.6)])
    points = np.concatenate([wall, ground.T]).astype(np.float32)
    T_camera_guess = euler.transforms([0.5, -1.0, 0.2, 0.1, -0.05, 0.15])
    settings = replace(SMALL, occlusion_radius=0)

    def seen(T_camera_from: np.ndarray) -> torch.Tensor:
        imager = imager_of(camera, settings)
        return imager.image(points, T_OPTICAL_BODY @ se3.inverse(T_camera_from))

    K = camera.K
    pinhole = torch.tensor([[K[0, 0], K[1, 1], K[0, 2], K[1, 2]]]).float()
    target = torch.from_numpy(targets(T_camera_guess[None])).float()
    image = seen(np.eye(4))[None, None].expand(1, 3, 32, 64)
    batch = Batch(image, seen(T_camera_guess)[None], target, pinhole)
    angle = 0.4
    turned = rolled(batch, np.array([angle]))

    T_roll = se3.from_rotation_translation(se3.so3_exp([angle, 0, 0]), np.zeros(3))
    for found, expected in (
        (turned.lidar[0], seen(T_camera_guess @ T_roll)),
        (turned.image[0, 0], seen(T_roll)),
    ):
        both = (found > 0) & (expected > 0)
        assert both.float().mean() > 0.4
        off = ((found - expected).abs() / expected)[both]
        assert off.median() < 0.03
        other = expected.flip(1)
        wrong = ((found - other).abs() / other)[(found > 0) & (other > 0)]
        assert wrong.median() > 3 * off.median(), 'the other way round it does not fit'
    T_guess = se3.inverse(T_camera_guess @ T_roll) @ T_roll
    np.testing.assert_allclose(turned.target[0], euler.components(T_guess), atol=1e-5)


def test_without_a_roll_nothing_is_drawn_for_it():
    batch = Batch(
        torch.full((4, 3, 32, 64), 100, dtype=torch.uint8), torch.ones(4, 32, 64),
        torch.zeros(4, 6), torch.tensor([[40.0, 40, 31, 15]]).expand(4, 4),
    )  # fmt: skip
    rng, again = np.random.default_rng(2), np.random.default_rng(2)
    plain = augmented(batch, rng, 0.0)
    assert torch.equal(plain.lidar, batch.lidar)
    tilted = augmented(batch, again, 0.1)
    assert (tilted.lidar == 0).any() and (plain.lidar > 0).all()
    np.testing.assert_allclose(tilted.target, 0.0, atol=1e-12)
