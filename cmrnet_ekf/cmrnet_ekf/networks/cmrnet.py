"""Regress where a camera is, from its image and the LiDAR image seen from a guess.

Cattaneo et al., "CMRNet: Camera to LiDAR-Map Registration", ITSC 2019; thesis section 5.2.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from cmrnet_ekf.networks import cell_flow
from cmrnet_ekf.networks.config import CmrnetConfig
from cmrnet_ekf.networks.correlation import correlate
from cmrnet_ekf.networks.heads import PoseHead
from cmrnet_ekf.networks.outputs import Output

_SLOPE = 0.1
_MEAN = (0.485, 0.456, 0.406)  # of ImageNet
_STD = (0.229, 0.224, 0.225)


class Cmrnet(nn.Module):
    """Predict T_guess_camera from an image and the map as the guess would see it.

    Both frames are the camera's with its axes turned to the vehicle's: x forward, y left, z up.
    `trunk` does nearly all the work; the head may be asked many times for one trunk pass.
    """

    def __init__(self, settings: CmrnetConfig) -> None:
        super().__init__()
        s = self.settings = settings.check()
        self.image_pyramid = _pyramid(3, s)
        self.lidar_pyramid = _pyramid(1, s)
        channels = (2 * s.displacement + 1) ** 2 + cell_flow.CHANNELS * bool(s.flow_sharpness)
        self.estimator = nn.ModuleList()
        for width in s.estimator:
            self.estimator.append(_convolution(channels, width))
            channels += width
        self.squeeze: nn.Module | None = None
        if s.squeezed:
            self.squeeze = nn.Sequential(nn.Conv2d(channels, s.squeezed, 1), nn.LeakyReLU(_SLOPE))
            channels = s.squeezed
        rows, columns = (s.pooled_rows, s.pooled_columns) if s.pooled_rows else s.grid
        self.head = PoseHead(s, channels * rows * columns)
        self.register_buffer('mean', torch.tensor(_MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer('std', torch.tensor(_STD).view(3, 1, 1), persistent=False)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                nn.init.kaiming_normal_(module.weight, mode='fan_in')
                nn.init.zeros_(module.bias)
        self.head.start()
        # Quicker on a CPU, and the same numbers up to rounding.
        self.to(memory_format=torch.channels_last)

    def forward(self, image: Tensor, lidar: Tensor) -> Output:
        """Return what the head says of images and LiDAR images; see `trunk`."""
        output: Output = self.head(self.trunk(image, lidar))
        return output

    def trunk(self, image: Tensor, lidar: Tensor) -> Tensor:
        """Return features [B x F].

        Args:
            image: [B x 3 x H x W] uint8 RGB (or float, 0..255).
            lidar: [B x H x W] depth in metres, 0 where nothing is seen.
        """
        return self.features(self.correlation(image, lidar), lidar)

    def correlation(self, image: Tensor, lidar: Tensor) -> Tensor:
        """Return how alike cells of both are [B x (2d+1)^2 x rows x columns]; see `correlate`."""
        seen = self.image_pyramid((image.float() / 255.0 - self.mean) / self.std)
        mapped = self.lidar_pyramid(lidar[:, None] / self.settings.max_depth)
        if self.settings.standardised:
            seen, mapped = _standardised(seen), _standardised(mapped)
        return correlate(seen, mapped, self.settings.displacement)

    def features(self, correlation: Tensor, lidar: Tensor) -> Tensor:
        """Return features [B x F] of a correlation and of the LiDAR image that it is of."""
        s = self.settings
        x = functional.leaky_relu(correlation, _SLOPE)
        if s.flow_sharpness:
            flow = cell_flow.cell_flow(
                correlation, lidar, s.displacement, s.flow_sharpness, s.focal or s.width
            )
            x = torch.cat([x, flow.to(x.dtype)], 1)
        for layer in self.estimator:
            x = torch.cat([layer(x), x], 1)
        if self.squeeze is not None:
            x = self.squeeze(x)
        if self.settings.pooled_rows:
            size = self.settings.pooled_rows, self.settings.pooled_columns
            x = functional.adaptive_avg_pool2d(x, size)
        return x.flatten(1)


def _standardised(x: Tensor) -> Tensor:
    """Give the features of each cell mean 0 and variance 1, but where there are none."""
    x = x.float()
    x = x - x.mean(1, keepdim=True)
    return x / (x.square().mean(1, keepdim=True) + 1e-4).sqrt()


def _pyramid(channels: int, s: CmrnetConfig) -> nn.Sequential:
    layers = []
    for width in s.pyramid:
        layers.append(_convolution(channels, width, stride=2))
        layers += [_convolution(width, width) for _ in range(s.convolutions - 1)]
        channels = width
    return nn.Sequential(*layers)


def _convolution(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1), nn.LeakyReLU(_SLOPE)
    )
