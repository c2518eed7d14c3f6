import json

import numpy as np
import pytest
import torch
from small_samples import street_samples

from cmrnet_ekf.pose_sampling import targets
from cmrnet_ekf.training.sample_set import SampleSet, draw
from lcd_common.errors import DataError


def test_draws_repeat_and_come_from_all_sets(tmp_path):
    sets = [street_samples(tmp_path / 'a', draws=1), street_samples(tmp_path / 'b', draws=3)]
    one = draw(sets, 50, np.random.default_rng(1), roll=0.05)
    again = draw(sets, 50, np.random.default_rng(1), roll=0.05)
    assert torch.equal(one.image, again.image) and torch.equal(one.target, again.target)
    assert one.image.shape == (50, 3, 32, 64) and one.lidar.shape == (50, 32, 64)
    plain = draw(sets, 400, np.random.default_rng(2))
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
