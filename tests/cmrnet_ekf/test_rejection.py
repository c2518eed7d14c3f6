import numpy as np
import pytest

from cmrnet_ekf.pose_belief import PoseBelief
from cmrnet_ekf.rejection import accepted, rejection_thresholds, traces


def test_a_prediction_is_kept_when_both_traces_are_low():
    rng = np.random.default_rng(7)
    scale = np.ones((1000, 6))
    scale[:, :3] *= rng.uniform(0.1, 1, (1000, 1))
    scale[:, 3:] *= rng.uniform(0.1, 1, (1000, 1))
    found = traces(PoseBelief(0 * scale, scale, np.full_like(scale, np.inf), scale**2))
    np.testing.assert_allclose(found, 3 * np.square(scale[:, [0, 3]]))
    keep = accepted(found, 0.15)
    # Independent traces: 15 % and 15 % of the rest go.
    assert 1 - keep.mean() == pytest.approx(1 - 0.85**2, abs=0.02)
    expected = (found <= np.quantile(found, 0.85, axis=0, method='higher')).all(1)
    assert (keep == expected).mean() > 0.995
    same = np.stack([found[:, 0], found[:, 0]], 1)
    assert 1 - accepted(same, 0.15).mean() == pytest.approx(0.15, abs=0.001)


def test_thresholds_may_be_fixed_beforehand():
    found = np.random.default_rng(8).exponential(size=(1000, 2))
    half, rest = found[:500], found[500:]
    keep = accepted(rest, thresholds=rejection_thresholds(half, 0.15))
    np.testing.assert_array_equal(keep, (rest <= np.sort(half, axis=0)[424]).all(1))
