"""Register clouds by LCDNet in the ways that the thesis tells apart (section 3.2.5)."""

import numpy as np
import torch
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.baselines.kiss_matching import KissMatcher
from lcd_loop_closure.feature_registration import (
    FeatureRegistration,
    FeatureRegistrationConfig,
    truncated_motion,
)
from lcd_loop_closure.lcdnet.network import Features
from lcd_loop_closure.lcdnet_descriptor import LcdnetDescriptor
from lcd_loop_closure.local_features import LocalFeatures
from lcd_loop_closure.loop import LoopStatus
from lcd_loop_closure.pair_registration import PairRegistration, PairResult, PreparedCloud
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud


class LcdnetFast:
    """By the transport head alone: "LCDNet (fast)"."""

    name = 'lcdnet_fast'

    def __init__(self, descriptor: LcdnetDescriptor) -> None:
        self._descriptor = descriptor

    def prepare(self, cloud: PointCloud) -> LocalFeatures:
        """Return keypoints and features of a sweep."""
        return self._descriptor.features(cloud)

    @torch.inference_mode()
    def register(self, match: LocalFeatures, query: LocalFeatures) -> se3.Array | None:
        """Return T_match_query."""
        network, device = self._descriptor.network, self._descriptor.device
        both = (query, match)
        features = Features(
            torch.stack([torch.from_numpy(one.keypoints) for one in both]).to(device),
            torch.stack([torch.from_numpy(one.values).float() for one in both]).to(device),
            torch.empty((2, 0), device=device),
            0,
        )
        source, target = (torch.tensor([k], device=device) for k in (0, 1))
        T = network.relative_pose(features, source, target)[0].double().cpu().numpy()
        return T if np.isfinite(T).all() else None


class LcdnetRansac:
    """By the matches of features that agree on one motion."""

    name = 'lcdnet_ransac'

    def __init__(
        self, descriptor: LcdnetDescriptor, settings: FeatureRegistrationConfig | None = None
    ) -> None:
        self._descriptor, self._registration = descriptor, FeatureRegistration(settings)

    def prepare(self, cloud: PointCloud) -> LocalFeatures:
        """Return keypoints and features of a sweep."""
        return self._descriptor.features(cloud)

    def register(self, match: LocalFeatures, query: LocalFeatures) -> se3.Array | None:
        """Return T_match_query; None without enough matches that agree."""
        found = self._registration.register(query, match)
        return found[0].T_match_query if found else None


class LcdnetGnc(LcdnetRansac):
    """By graduated non-convexity on the matches of features (GNC-TLS), all of them at once."""

    name = 'lcdnet_gnc'

    def register(self, match: LocalFeatures, query: LocalFeatures) -> se3.Array | None:
        """Return T_match_query; None without three matches that agree."""
        p, q = matched_keypoints(self._registration, match, query)
        bound_m = self._registration.settings.inlier_distance
        if len(p) < 3:
            return None
        T = truncated_motion(p, q, bound_m)
        near = np.linalg.norm(p @ T[:3, :3].T + T[:3, 3] - q, axis=1) < bound_m
        return T if np.count_nonzero(near) >= 3 else None


class LcdnetKissMatcher(LcdnetRansac):
    """By KISS-Matcher's solver on the matches of features; it stands in for TEASER++."""

    name = 'lcdnet_kiss_matcher'

    def __init__(self, descriptor: LcdnetDescriptor) -> None:
        """Find the package; raises MissingPackageError without it."""
        super().__init__(descriptor)
        self._solver = KissMatcher()

    def register(self, match: LocalFeatures, query: LocalFeatures) -> se3.Array | None:
        """Return T_match_query; None where the solver finds none."""
        p, q = matched_keypoints(self._registration, match, query)
        if len(p) < 3:
            return None
        return self._solver.solve(p.astype(np.float32), q.astype(np.float32))


def matched_keypoints(
    registration: FeatureRegistration, match: LocalFeatures, query: LocalFeatures
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return keypoints of the query [K x 3] and their partners in the match [K x 3], metres."""
    rows, columns, _ = registration.matches(
        query.values.astype(np.float32), match.values.astype(np.float32)
    )
    return (
        np.asarray(query.keypoints, np.float64)[rows],
        np.asarray(match.keypoints, np.float64)[columns],
    )


class NodeRegistration:
    """What the loop-closure node runs on two keyframes: features, refinement, verification.

    As `lcdnet` it answers with its best pose even where the verification rejects that; as
    `lcdnet_accepted` with what the node would pass on.
    """

    def __init__(self, descriptor: LcdnetDescriptor, *, accepted_only: bool = False) -> None:
        self.name = 'lcdnet_accepted' if accepted_only else 'lcdnet'
        self._descriptor, self._accepted_only = descriptor, accepted_only
        self._pairs = PairRegistration()

    def prepare(self, cloud: PointCloud) -> PreparedCloud:
        """Return features and the cloud that a keyframe keeps."""
        reduced = reduce_cloud(cloud, ReductionConfig())
        return self._pairs.prepare(reduced.xyz, self._descriptor.features(cloud))

    def register(self, match: PreparedCloud, query: PreparedCloud) -> se3.Array | None:
        """Return T_match_query; None without an answer."""
        result = self.judge(match, query)
        if self._accepted_only and result.status is not LoopStatus.ACCEPTED:
            return None
        return result.T_match_query

    def judge(self, match: PreparedCloud, query: PreparedCloud) -> PairResult:
        """Return the pose and the verdict on it."""
        return self._pairs.compare(match, query)
