"""Rank a database for many queries by the rule of each method, and say how sure the rule is."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from uncertain_place_recognition.retrieval.descriptor_rows import checked_metric, directions
from uncertain_place_recognition.uncertainty import (
    mean_descriptor,
    total_uncertainty,
    unit_uncertainty,
)

Array = NDArray[np.float32]
Allowed = NDArray[np.bool_]


@dataclass(frozen=True)
class Ranking:
    """The best entries of a database for each of Q queries, best first.

    Attributes:
        entry: [Q x K] int64 numbers of entries; -1 where no more were allowed.
        similarity: [Q x K] cosine, mean over members where a method has several databases.
        distance: [Q x K] Euclidean, mean likewise.
        doubt: [Q] by names of measures, more is worse.
    """

    entry: NDArray[np.int64]
    similarity: Array
    distance: Array
    doubt: dict[str, NDArray[np.float64]]


# (database [N x M x D], queries [Q x M x D], metric, k, allowed [Q x N]) -> Ranking
Method = Callable[[Array, Array, str, int, Allowed | None], Ranking]


def rank_single(
    database: Array, queries: Array, metric: str = 'cosine', k: int = 25,
    allowed: Allowed | None = None,
) -> Ranking:  # fmt: skip
    """Rank by one network: the first member. Doubt: `distance`, `similarity` of the best."""
    return _one_space(database[:, 0], queries[:, 0], metric, k, allowed)


def rank_mean(
    database: Array, queries: Array, metric: str = 'cosine', k: int = 25,
    allowed: Allowed | None = None,
) -> Ranking:  # fmt: skip
    """Rank by the mean embedding of all members, with one search (thesis equations 19, 22, 23).

    For members that share a space; of members trained apart it is the naive ensemble, and of passes
    with dropout MC dropout. Doubt: `distance` and `similarity` of the best, `u` (u_EV), `u_norm`
    (over the squared norm) and `u_unit` (of members of unit length).
    """
    ranked = _one_space(mean_descriptor(database), mean_descriptor(queries), metric, k, allowed)
    doubt = {
        'u': total_uncertainty(queries, normalised=False),
        'u_norm': total_uncertainty(queries),
        'u_unit': unit_uncertainty(queries),
    }
    return Ranking(ranked.entry, ranked.similarity, ranked.distance, {**ranked.doubt, **doubt})


def rank_per_member(
    database: Array, queries: Array, metric: str = 'cosine', k: int = 25,
    allowed: Allowed | None = None,
) -> Ranking:  # fmt: skip
    """Rank by the mean similarity (or distance) over members, each with a database of its own.

    Mason et al., "Uncertainty-Aware LiDAR Place Recognition in Novel Environments", IROS 2023: M
    searches of M databases. Doubt: `variance` of the members' similarities to the best entry,
    `similarity` and `distance`, the means to it (their released code scores the former).
    """
    members = range(database.shape[1])
    if checked_metric(metric) == 'cosine':
        score = sum(directions(queries[:, m]) @ directions(database[:, m]).T for m in members)
    else:
        score = -sum(_apart(queries[:, m], database[:, m]) for m in members)
    entry = _best(np.asarray(score), k, allowed)
    chosen = database[entry]  # [Q x K x M x D]
    cosine = np.einsum('qkmd,qmd->qkm', _units(chosen), _units(queries))
    apart = np.linalg.norm(chosen - queries[:, None], axis=-1)
    similarity, distance = cosine.mean(-1), apart.mean(-1)
    doubt = _of_best(similarity, distance)
    doubt['variance'] = cosine[:, 0].astype(np.float64).var(-1)
    return Ranking(entry, similarity, distance, doubt)


def rank_aleatoric(
    variance: Array,
) -> Method:
    """Return the rule of a network that predicts its own variance [Q x D] (STUN).

    Cai et al., "STUN: Self-Teaching Uncertainty Estimation for Place Recognition", IROS 2022. Doubt
    also has `variance`, the sum over features.
    """

    def rank(
        database: Array, queries: Array, metric: str = 'cosine', k: int = 25,
        allowed: Allowed | None = None,
    ) -> Ranking:  # fmt: skip
        ranked = rank_single(database, queries, metric, k, allowed)
        doubt = {**ranked.doubt, 'variance': variance.reshape(len(queries), -1).sum(1, np.float64)}
        return Ranking(ranked.entry, ranked.similarity, ranked.distance, doubt)

    return rank


def _one_space(
    database: Array, queries: Array, metric: str, k: int, allowed: Allowed | None
) -> Ranking:
    if checked_metric(metric) == 'cosine':
        score = directions(queries) @ directions(database).T
    else:
        score = -_apart(queries, database)
    entry = _best(score, k, allowed)
    chosen = database[entry]
    similarity = np.einsum('qkd,qd->qk', _units(chosen), _units(queries))
    distance = np.linalg.norm(chosen - queries[:, None], axis=-1)
    return Ranking(entry, similarity, distance, _of_best(similarity, distance))


def _of_best(similarity: Array, distance: Array) -> dict[str, NDArray[np.float64]]:
    return {
        'similarity': 1.0 - similarity[:, 0].astype(np.float64),
        'distance': distance[:, 0].astype(np.float64),
    }


def _best(score: Array, k: int, allowed: Allowed | None) -> NDArray[np.int64]:
    """Return the k entries of highest score [Q x K]; equal ones in their order; -1: none left."""
    if allowed is not None:
        score = np.where(allowed, score, -np.inf)
    # Stable and whole: databases of an evaluation are small, and ties must not depend on k.
    entry = np.argsort(-score, axis=1, kind='stable')[:, :k]
    if allowed is None:
        return entry
    return np.where(np.take_along_axis(allowed, entry, axis=1), entry, -1)


def _apart(queries: Array, database: Array) -> Array:
    total = np.einsum('ij,ij->i', queries, queries)[:, None]
    total = total + np.einsum('ij,ij->i', database, database)[None, :]
    return np.sqrt(np.maximum(total - 2.0 * (queries @ database.T), 0.0))


def _units(rows: Array) -> Array:
    norm = np.linalg.norm(rows, axis=-1, keepdims=True)
    return np.divide(rows, norm, out=np.zeros_like(rows), where=norm > 0.0)
