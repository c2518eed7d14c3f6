"""Register two clouds by the features of their keypoints."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.settings import config, setting
from lcd_loop_closure.local_features import LocalFeatures


@config
class FeatureRegistrationConfig:
    """How keypoints are matched and wrong matches are left out."""

    neighbours: int = setting(2, 'partners tried for each keypoint', low=1, high=20)
    mutual: bool = setting(True, 'a match must be among the best of both its keypoints')
    hypotheses: int = setting(800, 'motions tried', low=10)
    inlier_distance: float = setting(
        1.2, 'a match farther apart speaks against a motion', unit='m', low=0.1
    )
    min_separation: float = setting(
        5.0, 'matches that give a motion together are at least so far apart', unit='m', low=0.5
    )
    answers: int = setting(2, 'distinct motions returned', low=1, high=20)


@dataclass(frozen=True)
class FeatureHypothesis:
    """One answer.

    Attributes:
        T_match_query: pose of the query in the match.
        inliers: matches that agree with it.
        share: of all matches, 0..1.
    """

    T_match_query: se3.Array
    inliers: int
    share: float


class FeatureRegistration:
    """RANSAC over feature matches, with the two vehicles upright as roads let them be.

    Two matches give yaw and shift; the best motions are then solved in six degrees from all their
    inliers. Deterministic: the same features give the same answers.
    """

    def __init__(self, settings: FeatureRegistrationConfig | None = None) -> None:
        self.settings = settings or FeatureRegistrationConfig()

    def matches(
        self, query: NDArray[np.float32], match: NDArray[np.float32]
    ) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
        """Return rows of the query [K] and the match [K] with like features, and cosines [K]."""
        cosine = _unit(query) @ _unit(match).T
        k = min(self.settings.neighbours, cosine.shape[0], cosine.shape[1])
        chosen = _largest(cosine, k)
        if self.settings.mutual:
            chosen &= _largest(np.ascontiguousarray(cosine.T), k).T
        rows, columns = np.nonzero(chosen)
        return rows, columns, cosine[rows, columns]

    def register(self, query: LocalFeatures, match: LocalFeatures) -> list[FeatureHypothesis]:
        """Return what `search` finds for two sweeps."""
        return self.search(
            query.keypoints,
            query.values.astype(np.float32),
            match.keypoints,
            match.values.astype(np.float32),
        )

    def search(
        self,
        query_xyz: NDArray[np.floating],
        query: NDArray[np.float32],
        match_xyz: NDArray[np.floating],
        match: NDArray[np.float32],
    ) -> list[FeatureHypothesis]:
        """Return the best distinct motions, best first; none without enough matches.

        Args:
            query_xyz, match_xyz: [N x 3], [M x 3] keypoints, base frames, metres.
            query, match: [N x D], [M x D] their features.
        """
        s = self.settings
        rows, columns, cosine = self.matches(query, match)
        if len(rows) < 3:
            return []
        p = np.asarray(query_xyz, np.float64)[rows]
        q = np.asarray(match_xyz, np.float64)[columns]
        rng = np.random.default_rng(0)
        weight = np.maximum(cosine, 0.0) ** 4 + 1e-6
        drawn = rng.choice(len(p), (2, 4 * s.hypotheses), p=weight / weight.sum())
        yaw, shift = _upright_motions(p, q, drawn[0], drawn[1], s.min_separation)
        yaw, shift = yaw[: s.hypotheses], shift[: s.hypotheses]
        if not len(yaw):
            return []
        score = _agreement(p, q, weight, yaw, shift, s.inlier_distance)
        found: list[FeatureHypothesis] = []
        for at in np.argsort(-score, kind='stable')[: 20 * s.answers]:
            T = se3.rotation_z(float(yaw[at]))
            T[:3, 3] = shift[at]
            if any(_alike(T, one.T_match_query) for one in found):
                continue
            T, inliers = _polished(p, q, T, s.inlier_distance)
            if inliers >= 3 and not any(_alike(T, one.T_match_query) for one in found):
                found.append(FeatureHypothesis(T, inliers, inliers / len(p)))
            if len(found) == s.answers:
                break
        return sorted(found, key=lambda one: -one.inliers)


def truncated_motion(
    p: NDArray[np.float64], q: NDArray[np.float64], bound_m: float, iterations: int = 60
) -> se3.Array:
    """Return T_q_p of matched points by graduated non-convexity on truncated least squares.

    Yang et al., "Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020.
    """
    weight = np.ones(len(p))
    T = rigid_motion(p, q, weight)
    squared = _squared(T, p, q)
    mu = bound_m**2 / max(2.0 * float(squared.max()) - bound_m**2, 1e-9)
    for _ in range(iterations if mu > 0 else 0):
        low, high = mu / (mu + 1.0) * bound_m**2, (mu + 1.0) / mu * bound_m**2
        between = np.sqrt(bound_m**2 * mu * (mu + 1.0) / np.maximum(squared, 1e-12)) - mu
        weight = np.where(squared <= low, 1.0, np.where(squared >= high, 0.0, between))
        if weight.max() <= 0.0:
            break
        T = rigid_motion(p, q, weight)
        squared = _squared(T, p, q)
        if weight.sum() >= 3.0 and np.all((weight < 1e-3) | (weight > 1.0 - 1e-3)):
            break
        mu *= 1.4
    return T


def rigid_motion(
    p: NDArray[np.float64], q: NDArray[np.float64], weight: NDArray[np.float64]
) -> se3.Array:
    """Return T_q_p that moves points [N x 3] onto their partners best, weighted (Umeyama 1991)."""
    w = weight / weight.sum()
    p_mean, q_mean = w @ p, w @ q
    U, _, Vt = np.linalg.svd((p - p_mean).T @ ((q - q_mean) * w[:, None]))
    sign = np.diag([1.0, 1.0, np.sign(np.linalg.det(Vt.T @ U.T))])
    R = Vt.T @ sign @ U.T
    return se3.from_rotation_translation(R, q_mean - R @ p_mean)


def _largest(values: NDArray[np.float32], count: int) -> NDArray[np.bool_]:
    """Mark the largest values [N x M] of each row; a few passes are faster than a partition."""
    left, chosen, rows = values.copy(), np.zeros(values.shape, bool), np.arange(len(values))
    for _ in range(count):
        at = left.argmax(axis=1)
        chosen[rows, at] = True
        left[rows, at] = -np.inf
    return chosen


def _unit(features: NDArray[np.float32]) -> NDArray[np.float32]:
    features = np.asarray(features, np.float32)
    return features / np.maximum(np.linalg.norm(features, axis=1, keepdims=True), 1e-12)


def _upright_motions(
    p: NDArray[np.float64],
    q: NDArray[np.float64],
    first: NDArray[np.intp],
    second: NDArray[np.intp],
    least_m: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return yaw [H] and shift [H x 3] of pairs of matches whose distances agree."""
    in_p, in_q = p[second] - p[first], q[second] - q[first]
    long_p, long_q = np.hypot(in_p[:, 0], in_p[:, 1]), np.hypot(in_q[:, 0], in_q[:, 1])
    fits = (long_p > least_m) & (np.abs(long_p - long_q) < 2.0)
    fits &= np.abs(in_p[:, 2] - in_q[:, 2]) < 2.0 + 0.05 * long_p
    first, second, in_p, in_q = first[fits], second[fits], in_p[fits], in_q[fits]
    yaw = np.arctan2(in_q[:, 1], in_q[:, 0]) - np.arctan2(in_p[:, 1], in_p[:, 0])
    middle_p, middle_q = 0.5 * (p[first] + p[second]), 0.5 * (q[first] + q[second])
    c, s = np.cos(yaw), np.sin(yaw)
    turned = np.stack(
        [c * middle_p[:, 0] - s * middle_p[:, 1], s * middle_p[:, 0] + c * middle_p[:, 1],
         middle_p[:, 2]], 1,
    )  # fmt: skip
    return yaw, middle_q - turned


def _agreement(
    p: NDArray[np.float64],
    q: NDArray[np.float64],
    weight: NDArray[np.floating],
    yaw: NDArray[np.float64],
    shift: NDArray[np.float64],
    bound_m: float,
) -> NDArray[np.float32]:
    """Return the weighted count [H] of matches within the bound, nearer ones counting more."""
    p32, q32, shift32 = p.astype(np.float32), q.astype(np.float32), shift.astype(np.float32)
    c, s = np.cos(yaw).astype(np.float32)[:, None], np.sin(yaw).astype(np.float32)[:, None]
    squared = (c * p32[:, 0] - s * p32[:, 1] + shift32[:, :1] - q32[:, 0]) ** 2
    squared += (s * p32[:, 0] + c * p32[:, 1] + shift32[:, 1:2] - q32[:, 1]) ** 2
    # Heights bend with roll, pitch and hills that yaw alone does not know.
    squared += 0.25 * (p32[:, 2] + shift32[:, 2:] - q32[:, 2]) ** 2
    agree = np.maximum(1.0 - squared / np.float32(bound_m**2), 0.0)
    return np.asarray(agree @ np.asarray(weight, np.float32))


def _polished(
    p: NDArray[np.float64], q: NDArray[np.float64], T: se3.Array, bound_m: float
) -> tuple[se3.Array, int]:
    """Solve in six degrees from the inliers, three times; return the motion and their number."""
    for bound in (1.5 * bound_m, bound_m, bound_m):
        near = _squared(T, p, q) < bound**2
        if np.count_nonzero(near) < 3:
            break
        moved = rigid_motion(p[near], q[near], np.ones(int(near.sum())))
        if moved[2, 2] < 0.9:  # three matches on a line may turn it over
            break
        T = moved
    return T, int(np.count_nonzero(_squared(T, p, q) < bound_m**2))


def _squared(T: se3.Array, p: NDArray[np.float64], q: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sum((p @ T[:3, :3].T + T[:3, 3] - q) ** 2, axis=1))


def _alike(a: se3.Array, b: se3.Array) -> bool:
    metres, radians = se3.distance(a, b)
    return metres < 2.0 and radians < 0.2
