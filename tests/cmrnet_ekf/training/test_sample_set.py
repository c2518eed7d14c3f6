import json

import numpy as np
import pytest
import torch
from small_samples import CAMERA, SMALL, street_samples

from cmrnet_ekf import euler
from cmrnet_ekf.camera_localizer import framing_of, imager_of
from cmrnet_ekf.pose_sampling import T_OPTICAL_BODY, targets
from cmrnet_ekf.training.sample_set import Batch, SampleSet, draw, mirrored
from lcd_common import se3
from lcd_common.errors import DataError


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
    from dataclasses import replace

    T_mirrored = M @ T_camera_guess @ M
    expected = imager_of(replace(camera, K=K), SMALL).image(
        points * [1, -1, 1], T_OPTICAL_BODY @ se3.inverse(T_mirrored)
    )
    different = (flipped.lidar[0] - expected).abs() > 1e-3
    assert different.float().mean() < 0.01, 'but for points on the borders of pixels'
    np.testing.assert_allclose(flipped.target, targets(T_mirrored[None]), atol=1e-6)
    assert torch.equal(mirrored(batch, torch.tensor([False])).lidar, batch.lidar)


def test_draws_repeat_and_come_from_all_sets(tmp_path):
    sets = [street_samples(tmp_path / 'a', draws=1), street_samples(tmp_path / 'b', draws=3)]
    one = draw(sets, 50, np.random.default_rng(1), augment=True)
    again = draw(sets, 50, np.random.default_rng(1), augment=True)
    assert torch.equal(one.image, again.image) and torch.equal(one.target, again.target)
    assert one.image.shape == (50, 3, 32, 64) and one.lidar.shape == (50, 32, 64)
    plain = draw(sets, 400, np.random.default_rng(2), augment=False)
    known = np.concatenate([targets(np.asarray(s.guesses)) for s in sets])
    nearest = np.abs(plain.target.numpy()[:, None] - known[None]).max(2).argmin(1)
    assert len(np.unique(nearest)) == len(known)
    assert (nearest >= len(sets[0])).mean() == pytest.approx(0.75, abs=0.1)


def test_broken_sets_are_refused(tmp_path):
    with pytest.raises(DataError, match='make_cmrnet_samples'):
        SampleSet(tmp_path)
    samples = street_samples(tmp_path)
    facts = json.loads((samples.path / 'facts.json').read_text())
    (samples.path / 'facts.json').write_text(json.dumps({**facts, 'version': 0}))
    with pytest.raises(DataError, match='version'):
        SampleSet(samples.path)
    (samples.path / 'facts.json').write_text(json.dumps(facts))
    np.save(samples.path / 'frame_of.npy', np.zeros(2, np.int64))
    with pytest.raises(DataError, match='lengths'):
        SampleSet(samples.path)
