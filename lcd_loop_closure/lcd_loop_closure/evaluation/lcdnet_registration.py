"""Register clouds by LCDNet in the ways that the thesis tells apart (section 3.2.5)."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.feature_registration import (
    FeatureHypothesis,
    FeatureRegistration,
    FeatureRegistrationConfig,
)
from lcd_loop_closure.lcdnet.network import Features
from lcd_loop_closure.lcdnet_descriptor import LcdnetDescriptor
from lcd_loop_closure.local_features import LocalFeatures
from lcd_loop_closure.reduction import ReductionConfig, reduce_cloud
from lcd_loop_closure.refinement import Refinement, Surface
from lcd_loop_closure.verification import Verification


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
        found = self.search(match, query)
        return found[0].T_match_query if found else None

    def search(self, match: LocalFeatures, query: LocalFeatures) -> list[FeatureHypothesis]:
        """Return the best motions, best first."""
        return self._registration.search(
            query.keypoints,
            query.values.astype(np.float32),
            match.keypoints,
            match.values.astype(np.float32),
        )


@dataclass(frozen=True)
class RefinedSweep:
    """A sweep made ready for `LcdnetRefined`."""

    local: LocalFeatures
    xyz: NDArray[np.float32]
    refinement: Refinement

    @cached_property
    def surface(self) -> Surface:
        """Points of the reduced cloud with their covariances."""
        return self.refinement.surface(self.xyz)

    @property
    def ground_z(self) -> float:
        """Height below which points are ground."""
        return 0.0


class LcdnetRefined:
    """By features, then GICP from the best answers: what the node runs on two keyframes."""

    name = 'lcdnet'

    def __init__(self, descriptor: LcdnetDescriptor) -> None:
        self._rough = LcdnetRansac(descriptor)
        self._refinement, self._verification = Refinement(), Verification()

    def prepare(self, cloud: PointCloud) -> RefinedSweep:
        """Return features and the cloud that a keyframe keeps."""
        reduced = reduce_cloud(cloud, ReductionConfig())
        return RefinedSweep(self._rough.prepare(cloud), reduced.xyz, self._refinement)

    def register(self, match: RefinedSweep, query: RefinedSweep) -> se3.Array | None:
        """Return T_match_query of the answer whose clouds fit best; None without an answer."""
        fits = []
        for hypothesis in self._rough.search(match.local, query.local):
            T = self._refinement.approach(match.surface, query.surface, hypothesis.T_match_query)
            fitness = self._verification.fitness(match.surface, query.surface, T, query.ground_z)
            fits.append((fitness, T))
        if not fits:
            return None
        _, T_match_query = max(fits, key=lambda fit: fit[0])
        return self._refinement.refine(match.surface, query.surface, T_match_query).T_match_query
