"""Turn distance, uncertainty and ambiguity into one probability that a match is wrong."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.special import expit, log_expit
from scipy.stats import norm

from lcd_common.errors import DataError, MapError

FEATURES = ('distance', 'uncertainty', 'ambiguity', 'ratio')
_KNOTS = 33
_SLOPE = 3.0  # spread of slopes that is expected, of a normal prior
# Of normal scores: between neighbours the logit rises in a straight line.
_BENDS = np.array([-np.inf, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, np.inf])
Array = NDArray[np.float64]


@dataclass(frozen=True)
class MatchFeatures:
    """What speaks against a match; of all, more is worse.

    Attributes:
        distance: of the query to its best match: nothing in the map looks like it.
        uncertainty: u_EV, normalised: the input is unlike what the ensemble was trained on.
        ambiguity: spread of the best matches, metres: several places look like it.
        ratio: best distance over that of the best other place, 0 .. 1.
    """

    distance: float
    uncertainty: float
    ambiguity: float
    ratio: float

    def row(self) -> Array:
        """Return the features [F] in the order of FEATURES."""
        return np.array(astuple(self), np.float64)


@dataclass(frozen=True)
class MatchModel:
    """A logistic model that never believes a match more because something speaks against it.

    Every feature becomes the normal score of its rank among the calibration's queries, so that
    units and heavy tails do not matter; the logit of a wrong match is a sum of functions of these
    that rise in straight pieces. Beyond the range of the calibration scores go on as a logarithm.

    Attributes:
        names: of the features.
        knots: [F x K] quantiles of each feature, rising.
        scores: [F x K] normal scores of the knots.
        weights: [F x 8] slope of each piece, at least 0.
        intercept: of the logit.
    """

    names: tuple[str, ...]
    knots: Array
    scores: Array
    weights: Array
    intercept: float

    @staticmethod
    def fit(rows: ArrayLike, wrong: ArrayLike, names: Sequence[str] = FEATURES) -> 'MatchModel':
        """Fit a model to queries of calibration runs, by penalised maximum likelihood.

        Args:
            rows: [N x F] features, more is worse.
            wrong: [N] whether the best match is of another place.
            names: of the features.

        Raises:
            DataError: matches are all right or all wrong, or the shapes do not fit.
        """
        x, y = np.asarray(rows, np.float64), np.asarray(wrong, bool)
        if x.shape != (len(y), len(names)):
            raise DataError(
                f'expected {len(y)} rows of {len(names)} features ({", ".join(names)}), got the '
                f'shape {x.shape}'
            )
        if not np.isfinite(x).all():
            raise DataError('expected finite features, got NaN or infinity')
        if y.all() or not y.any():
            raise DataError(
                f'all {len(y)} matches are {"wrong" if y.all() else "right"}: a probability needs '
                'both; add runs, or queries whose place is not in the map'
            )
        curves = [_curve(column) for column in x.T]
        knots, scores = (np.stack(part) for part in zip(*curves, strict=True))
        basis = _basis(x, knots, scores)
        sign, ridge = np.where(y, 1.0, -1.0), 0.5 / (_SLOPE**2 * len(y))

        def loss(parameters: Array) -> tuple[float, Array]:
            weights, intercept = parameters[1:], parameters[0]
            margin = sign * (basis @ weights + intercept)
            slope = -sign * expit(-margin) / len(y)
            value = -log_expit(margin).mean() + ridge * weights @ weights
            gradient = basis.T @ slope + 2.0 * ridge * weights
            return float(value), np.concatenate([[slope.sum()], gradient])

        share = y.mean()
        start = np.concatenate([[np.log(share / (1.0 - share))], np.full(basis.shape[1], 0.1)])
        bounds = [(None, None)] + [(0.0, None)] * basis.shape[1]
        found = minimize(loss, start, jac=True, bounds=bounds, method='L-BFGS-B').x
        weights = found[1:].reshape(len(names), -1)
        return MatchModel(tuple(names), knots, scores, weights, float(found[0]))

    def false_match_probability(self, features: 'MatchFeatures | ArrayLike') -> Array:
        """Return the probability [...] that a match is wrong, of features or rows [... x F].

        It holds for queries as those of the calibration, and for their share of places that the
        map does not have. A feature that is not finite makes a match wrong for sure.
        """
        return expit(-self.belief(features))

    def belief(self, features: 'MatchFeatures | ArrayLike') -> Array:
        """Return the logit [...] that a match is right: what acceptances compare with."""
        rows = features.row() if isinstance(features, MatchFeatures) else features
        x = np.asarray(rows, np.float64)
        if x.shape[-1:] != (len(self.names),):
            raise DataError(
                f'expected {len(self.names)} features ({", ".join(self.names)}), got the shape '
                f'{x.shape}'
            )
        finite = np.isfinite(x).all(-1)
        basis = _basis(np.where(np.expand_dims(finite, -1), x, 0.0), self.knots, self.scores)
        return np.where(finite, -(basis @ self.weights.ravel() + self.intercept), -np.inf)

    def plain(self) -> dict[str, Any]:
        """Return the model as JSON has it."""
        return {
            'names': list(self.names),
            'knots': self.knots.tolist(),
            'scores': self.scores.tolist(),
            'weights': self.weights.tolist(),
            'intercept': self.intercept,
        }

    @staticmethod
    def from_plain(plain: Mapping[str, Any]) -> 'MatchModel':
        """Return what `plain` gave; raises MapError when it is no model."""
        try:
            names = tuple(map(str, plain['names']))
            knots, scores, weights = (
                np.array(plain[key], np.float64) for key in ('knots', 'scores', 'weights')
            )
            intercept = float(plain['intercept'])
        except (KeyError, TypeError, ValueError) as error:
            raise MapError(f'no model of match probabilities: {error!r}') from None
        pieces = (len(names), len(_BENDS) - 1)
        if knots.shape != scores.shape or len(knots) != len(names) or weights.shape != pieces:
            raise MapError('a model of match probabilities whose parts do not fit together')
        return MatchModel(names, knots, scores, weights, intercept)

    def save(self, path: Path) -> None:
        """Write the model as JSON."""
        path.write_text(json.dumps(self.plain(), indent=2) + '\n')

    @staticmethod
    def load(path: Path) -> 'MatchModel':
        """Read what `save` wrote; raises MapError when the file is none."""
        try:
            return MatchModel.from_plain(json.loads(path.read_text()))
        except (ValueError, TypeError) as error:
            raise MapError(f'{path} is no model of match probabilities ({error})') from None


def _curve(column: Array) -> tuple[Array, Array]:
    """Return quantiles [K] and their normal scores; equal quantiles share the mean score."""
    level = (np.arange(_KNOTS) + 0.5) / _KNOTS
    knots = np.quantile(column, level)
    score = norm.ppf(level)
    distinct, group = np.unique(knots, return_inverse=True)
    shared = np.bincount(group, score) / np.bincount(group)
    # Of equal length for all features: what is missing repeats the last knot.
    pad = _KNOTS - len(distinct)
    return np.pad(distinct, (0, pad), 'edge'), np.pad(shared, (0, pad), 'edge')


def _basis(x: Array, knots: Array, scores: Array) -> Array:
    """Return [... x 8F]: of every feature, how much of its normal score lies in each piece."""
    columns = []
    for number, (at, value) in enumerate(zip(knots, scores, strict=True)):
        one = x[..., number]
        score = np.interp(one, at, value)
        run = at[-1] - at[0]
        if run > 0.0:
            # Outside, order is kept, but tails may be heavy: a logarithm.
            outside = (one - np.clip(one, at[0], at[-1])) / run
            score = score + np.sign(outside) * np.log1p(np.abs(outside))
        # Pieces begin at the bend that is nearer to zero, so that their sum is the score.
        for low, high in pairwise(_BENDS):
            origin = low if np.isfinite(low) and low >= 0.0 else high
            columns.append(np.clip(score, low, high) - origin)
    return np.stack(columns, axis=-1)
