"""Answers whose errors and laws are known."""

import numpy as np

from cmrnet_ekf.evaluation.answers import Answers
from cmrnet_ekf.pose_belief import PoseBelief

SIGMAS = np.array([0.4, 0.3, 0.2, 0.02, 0.03, 0.05])


def known_answers(
    count: int = 2000, told: float = 1.0, freedom: float = np.inf, seed: int = 0, kind: str = 'der'
) -> Answers:
    """Return answers off by draws of a law whose scale, of each sample its own, is told `told`."""
    rng = np.random.default_rng(seed)
    target = rng.uniform(-1, 1, (count, 6)) * [2, 2, 1, 0.15, 0.15, 0.15]
    scale = SIGMAS * rng.uniform(0.2, 3.0, (count, 1))
    draws = rng.normal(size=(count, 6))
    if np.isfinite(freedom):
        draws = rng.standard_t(freedom, (count, 6))
    belief = PoseBelief(
        target - draws * scale, told * scale, np.full((count, 6), freedom), np.square(scale)
    )
    return Answers(kind, belief, target)


def perfect_answers(count: int = 50) -> Answers:
    """Return answers without error, by a method that does not say how sure it is."""
    target = np.random.default_rng(1).uniform(-0.2, 0.2, (count, 6))
    nothing = np.zeros_like(target)
    return Answers(
        'plain', PoseBelief(target, nothing, np.full_like(target, np.inf), nothing), target
    )
