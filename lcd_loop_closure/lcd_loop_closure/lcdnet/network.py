"""The whole network: clouds in, keypoint features and descriptors out."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from lcd_loop_closure.lcdnet.config import LcdnetConfig
from lcd_loop_closure.lcdnet.keypoints import above_ground, farthest_points
from lcd_loop_closure.lcdnet.netvlad import NetVlad, with_ranges
from lcd_loop_closure.lcdnet.point_backbones import EdgeConv, PointNet, RandlaNet
from lcd_loop_closure.lcdnet.pose_heads import RegressionHead
from lcd_loop_closure.lcdnet.pyramid import VoxelPyramid
from lcd_loop_closure.lcdnet.set_abstraction import VoxelSetAbstraction
from lcd_loop_closure.lcdnet.transport import SoftMatches, TransportHead
from lcd_loop_closure.lcdnet.voxels import Clouds, Voxels, see
from lcd_loop_closure.lcdnet.weighted_svd import weighted_svd

_POINT_BACKBONES = {'pointnet': PointNet, 'edgeconv': EdgeConv, 'randla': RandlaNet}


@dataclass(frozen=True)
class Features:
    """What the network says of a batch of clouds.

    Attributes:
        keypoints: [B x N x 3] float32, base frame, metres.
        features: [B x N x D].
        descriptors: [B x G], unit length.
        left_out: voxels beyond the cap, over all clouds.
    """

    keypoints: Tensor
    features: Tensor
    descriptors: Tensor
    left_out: int


class Lcdnet(nn.Module):
    """Describe clouds and match them (thesis Figure 3.2)."""

    def __init__(self, settings: LcdnetConfig) -> None:
        super().__init__()
        s = self.settings = settings.check()
        self.pyramid: VoxelPyramid | None = None
        self.abstraction: VoxelSetAbstraction | None = None
        if s.backbone == 'pv_rcnn':
            self.pyramid = VoxelPyramid(s)
            self.abstraction = VoxelSetAbstraction(s, self.pyramid.bev_size)
        else:
            self.of_points = _POINT_BACKBONES[s.backbone](s.feature_size, s.reach)
        self.place = NetVlad(s.feature_size + s.place_ranges, s.clusters, s.descriptor_size)
        self.transport: TransportHead | None = None
        if s.pose_head == 'uot':
            self.transport = TransportHead(s.sinkhorn_iterations)
        else:
            self.regression = RegressionHead(s.pose_head, s.feature_size, s.reach)

    def forward(
        self,
        clouds: Clouds,
        *,
        keypoints: int | None = None,
        generator: np.random.Generator | None = None,
    ) -> Features:
        """Return keypoints, features and descriptors.

        Args:
            clouds: the batch.
            keypoints: how many for each cloud; None: as configured.
            generator: of random choices while training (first keypoint, neighbours); None: none.
        """
        number = keypoints or self.settings.keypoints
        voxels = see(clouds, self.settings)
        chosen = self._keypoints(clouds, voxels, number, generator)
        batch = torch.arange(clouds.size, device=chosen.device).repeat_interleave(number)
        if self.pyramid is not None and self.abstraction is not None:
            pyramid = self.pyramid(voxels, clouds.size)
            features = self.abstraction(clouds, voxels, pyramid, chosen, batch, generator)
            features = features.view(clouds.size, number, -1)
        else:
            features = self.of_points(chosen.view(clouds.size, number, 3))
        at = chosen.view(clouds.size, number, 3)
        return Features(at, features, self.describe(features, at), voxels.left_out)

    def describe(self, features: Tensor, keypoints: Tensor) -> Tensor:
        """Return descriptors [B x G] of features [B x N x D] at keypoints [B x N x 3]."""
        s = self.settings
        if s.place_ranges:
            features = with_ranges(features, keypoints, s.place_ranges, s.reach)
        return self.place(features)

    def match(self, features: Features, source: Tensor, target: Tensor) -> SoftMatches | None:
        """Match clouds `source` [P] of a batch softly to clouds `target` [P].

        None when the pose head does not match.
        """
        if self.transport is None:
            return None
        return self.transport(
            features.features[source], features.features[target], features.keypoints[target]
        )

    def relative_pose(self, features: Features, source: Tensor, target: Tensor) -> Tensor:
        """Return T_target_source [P x 4 x 4] of pairs in a batch, by the pose head ("fast")."""
        matches = self.match(features, source, target)
        if matches is None:
            return self.regression(
                features.features[source],
                features.keypoints[source],
                features.features[target],
                features.keypoints[target],
            )
        return weighted_svd(features.keypoints[source].float(), matches.projected, matches.weight)

    def _keypoints(
        self,
        clouds: Clouds,
        voxels: Voxels,
        number: int,
        generator: np.random.Generator | None,
    ) -> Tensor:
        """Choose keypoints [B N x 3]: of the points, or of finest voxels that are coarse."""
        s, chosen = self.settings, []
        of_points = not s.relative_input
        xyz = clouds.xyz if of_points else voxels.xyz
        batch = clouds.batch if of_points else voxels.tensor.coordinates[:, 0]
        for cloud in range(clouds.size):
            own = xyz[batch == cloud]
            if of_points:
                own = own[(own[:, :2].abs() < s.reach).all(1)]
            if s.keypoint_height > 0.0:
                structure = own[above_ground(own, s.keypoint_height)]
                # An open field has no structure: rather the ground than nothing.
                own = structure if len(structure) >= number // 4 else own
            if not len(own):
                own = xyz.new_zeros((1, 3))
            first = 0 if generator is None else int(generator.integers(len(own)))
            chosen.append(own[farthest_points(own, number, first)])
        return torch.cat(chosen)
