"""Regress the relative pose directly: what the thesis's Table 3.9 compares transport with."""

import torch
from torch import Tensor, nn

_SIZES = {'mlp_sincos': 2, 'mlp_quaternion': 4, 'mlp_bingham': 10}


class RegressionHead(nn.Module):
    """Pool the keypoints of two clouds and regress T_target_source from both."""

    def __init__(self, kind: str, feature_size: int, reach_m: float, width: int = 256) -> None:
        """Make a head of a kind: mlp_sincos, mlp_quaternion or mlp_bingham."""
        super().__init__()
        self.kind, self.reach_m = kind, reach_m
        self.pool = nn.Sequential(
            nn.Linear(feature_size + 3, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU()
        )
        self.regress = nn.Sequential(
            nn.Linear(2 * width, width), nn.ReLU(), nn.Linear(width, 3 + _SIZES[kind])
        )

    def forward(
        self, source: Tensor, source_xyz: Tensor, target: Tensor, target_xyz: Tensor
    ) -> Tensor:
        """Return T [P x 4 x 4] of features [P x N x D] at keypoints [P x N x 3]."""
        pooled = [
            self.pool(torch.cat([features, xyz / self.reach_m], 2)).amax(1)
            for features, xyz in ((source, source_xyz), (target, target_xyz))
        ]
        out = self.regress(torch.cat(pooled, 1)).float()
        R = {
            'mlp_sincos': _from_sine_and_cosine,
            'mlp_quaternion': _from_quaternion,
            'mlp_bingham': _from_bingham,
        }[self.kind](out[:, 3:])
        T = torch.zeros((len(R), 4, 4), dtype=R.dtype, device=R.device)
        T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R, 10.0 * out[:, :3], 1.0
        return T


def _from_sine_and_cosine(values: Tensor) -> Tensor:
    """Return rotations about z from (sine, cosine) of any length [P x 2]."""
    sine, cosine = nn.functional.normalize(values, dim=1).unbind(1)
    zero, one = torch.zeros_like(sine), torch.ones_like(sine)
    rows = [cosine, -sine, zero, sine, cosine, zero, zero, zero, one]
    return torch.stack(rows, 1).view(-1, 3, 3)


def _from_quaternion(values: Tensor) -> Tensor:
    """Return rotations from quaternions x y z w of any length [P x 4]."""
    x, y, z, w = nn.functional.normalize(values, dim=1).unbind(1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
        2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
        2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, 1).view(-1, 3, 3)


def _from_bingham(values: Tensor) -> Tensor:
    """Return rotations from the ten numbers of a symmetric matrix [P x 10].

    The quaternion is the eigenvector of the smallest eigenvalue, the mode of a Bingham distribution
    (Peretroukhin et al., "A Smooth Representation of Belief over SO(3)", RSS 2020).
    """
    rows, columns = torch.triu_indices(4, 4)
    A = values.new_zeros((len(values), 4, 4))
    A[:, rows, columns] = values
    A = A + A.transpose(1, 2) - torch.diag_embed(torch.diagonal(A, dim1=1, dim2=2))
    _, vectors = torch.linalg.eigh(A)
    return _from_quaternion(vectors[..., 0])
