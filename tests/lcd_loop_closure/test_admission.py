"""Loops enter when the estimate explains them; its covariance is asked only where it decides."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from lcd_common import se3
from lcd_loop_closure.admission import Admission, PoseGraphConfig


def loop(sigma: float) -> Any:
    return SimpleNamespace(T_match_query=np.eye(4), covariance=np.eye(6) * sigma**2)


@pytest.mark.parametrize('seed', range(40))
def test_the_verdict_is_that_of_both_covariances(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6)) * 0.05
    covariance, asked = root @ root.T, []
    error = rng.normal(size=6) * rng.choice([0.01, 0.1, 0.3])
    measured = loop(0.03)

    def of_estimate() -> se3.Array:
        asked.append(True)
        return covariance

    admission = Admission(PoseGraphConfig(admission_angle=3.0))
    _, against = admission.objection(measured, se3.exp(error), of_estimate)
    squared = error @ np.linalg.solve(covariance + measured.covariance, error)
    limit = chi2.ppf(PoseGraphConfig().admission_probability, 6)
    assert bool(against) == (squared > limit)
    assert bool(asked) == (error @ error / 0.03**2 > limit)


def test_a_large_shift_waits_even_when_it_is_explained() -> None:
    far = se3.exp(np.r_[12.0, np.zeros(5)])
    metres, against = Admission(PoseGraphConfig()).objection(
        loop(0.03), far, lambda: np.eye(6) * 100.0
    )
    assert metres == pytest.approx(12.0)
    assert 'asks for a shift of 12.0 m' in against
