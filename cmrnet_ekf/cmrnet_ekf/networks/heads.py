"""Turn features into a pose: one shared layer, then a branch each for translation and rotation."""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from torch.nn import functional

from cmrnet_ekf.networks.config import CmrnetConfig
from cmrnet_ekf.networks.outputs import Evidence, GaussianPose, Output, QuaternionPose

_SLOPE = 0.1
# softplus comes arbitrarily near to 0, where the distributions end: variances are infinite at
# alpha = 1. The least alpha makes the predictive variance 101 times the squared scale.
_LEAST_NU, _LEAST_ALPHA, _LEAST_BETA = 1e-4, 1.01, 1e-9
_LOG_SIGMA = 12.0  # bound of the logarithm of the information root's diagonal


class PoseHead(nn.Module):
    """The FC layers of CMRNet, with one of three kinds of output."""

    def __init__(self, settings: CmrnetConfig, features: int) -> None:
        super().__init__()
        s = self.settings = settings
        self.dropout = nn.Dropout(s.dropout)
        self.shared = nn.Linear(features, s.hidden)
        sizes = {'quaternion': (3, 4), 'evidential': (12, 12), 'covariance': (3, 3)}[s.head]
        self.translation = nn.ModuleList(
            [nn.Linear(s.hidden, s.branch), nn.Linear(s.branch, sizes[0])]
        )
        self.rotation = nn.ModuleList(
            [nn.Linear(s.hidden, s.branch), nn.Linear(s.branch, sizes[1])]
        )
        self.correlated: nn.Linear | None = None
        if s.head == 'covariance':
            self.correlated = nn.Linear(2 * s.branch, 21)

    def start(self) -> None:
        """Begin near 'no correction', moderately sure."""
        with torch.no_grad():
            for branch in (self.translation, self.rotation):
                branch[1].weight *= 0.1
            if self.settings.head == 'quaternion':
                self.rotation[1].bias[3] = 1.0
            elif self.settings.head == 'evidential':
                # beta of angles: a scale of 0.1 rad. Of a scale of 1 rad the density of every
                # angle lies below the floor of L^D, which then has no gradient.
                self.rotation[1].bias[9:] = -5.0
            elif self.correlated is not None:
                self.correlated.weight *= 0.1

    def forward(
        self, features: Tensor, dropout: Callable[[Tensor], Tensor] | None = None
    ) -> Output:
        """Return the output of features [B x F]; in training mode of a draw.

        With a `dropout` of somebody else's it is asked in place of the head's own. Computed in full
        precision even under autocast: distributions end where half rounds to.
        """
        with torch.autocast(features.device.type, enabled=False):
            return self._output(features.float(), dropout or self.dropout)

    def _output(self, features: Tensor, dropout: Callable[[Tensor], Tensor]) -> Output:
        x = functional.leaky_relu(self.shared(dropout(features)), _SLOPE)
        near = [
            functional.leaky_relu(branch[0](dropout(x)), _SLOPE)
            for branch in (self.translation, self.rotation)
        ]
        t = self.translation[1](dropout(near[0]))
        r = self.rotation[1](dropout(near[1]))
        if self.settings.head == 'quaternion':
            return QuaternionPose(t, functional.normalize(r, dim=1))
        if self.settings.head == 'evidential':
            return _evidence(torch.cat([t.view(-1, 4, 3), r.view(-1, 4, 3)], dim=2))
        assert self.correlated is not None
        root = _lower_triangle(self.correlated(dropout(torch.cat(near, 1))))
        return GaussianPose(torch.cat([t, r], 1), root)


def _evidence(raw: Tensor) -> Evidence:
    gamma, nu, alpha, beta = raw.unbind(1)
    return Evidence(
        gamma,
        functional.softplus(nu) + _LEAST_NU,
        functional.softplus(alpha) + _LEAST_ALPHA,
        functional.softplus(beta) + _LEAST_BETA,
    )


def _lower_triangle(raw: Tensor) -> Tensor:
    """Fill [B x 21] into [B x 6 x 6] with a positive diagonal."""
    root = raw.new_zeros((len(raw), 6, 6))
    rows, columns = torch.tril_indices(6, 6, -1)
    diagonal = torch.arange(6)
    root[:, diagonal, diagonal] = raw[:, :6].clamp(-_LOG_SIGMA, _LOG_SIGMA).exp()
    root[:, rows, columns] = raw[:, 6:]
    return root
