"""Describe sweeps by LCDNet, and give the features that register them from the same pass."""

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_common.device import choose_device
from lcd_common.errors import ConfigError, DataError
from lcd_loop_closure.descriptor_index import Euclidean
from lcd_loop_closure.lcdnet.checkpoint import load_network
from lcd_loop_closure.lcdnet.network import Lcdnet
from lcd_loop_closure.lcdnet.places import thinned
from lcd_loop_closure.lcdnet.voxels import Clouds
from lcd_loop_closure.lcdnet_settings import LcdnetDescriptorConfig
from lcd_loop_closure.local_features import LocalFeatures

PACKAGED = Path(__file__).with_name('weights') / 'lcdnet_compact.safetensors'
# Fewer points show no place.
_LEAST_POINTS = 100
_logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SweepFeatures:
    """All that one pass of the network says of a sweep.

    Attributes:
        descriptor: [G] float32, of unit length.
        local: keypoints with their features.
        left_out: voxels beyond the network's cap.
    """

    descriptor: NDArray[np.float32]
    local: LocalFeatures
    left_out: int


class LcdnetDescriptor:
    """Make descriptors [G] of unit length, compared by their L2 distance (thesis section 3.2).

    The sweep is thinned as in training, wherever it comes from. Intensities above
    `full_intensity` on many points cannot be what the setting says: the network is then shown none,
    as it was for a share of its training.
    """

    name = 'lcdnet'
    unit_length = True

    def __init__(
        self, settings: LcdnetDescriptorConfig | None = None, network: Lcdnet | None = None
    ) -> None:
        """Load the network; `network` takes its place, ready to use.

        Raises:
            ConfigError: there are no weights, or no such device.
            DataError: the file holds other things.
        """
        self.settings = s = settings or LcdnetDescriptorConfig()
        self.device = choose_device(s.device)
        if s.threads:
            torch.set_num_threads(s.threads)
        self.network = _load(s.weights, self.device) if network is None else network
        self.network.to(self.device).eval()
        self._metric = Euclidean(self.length, unit_length=True)
        self._last: tuple[PointCloud, SweepFeatures] | None = None
        self._warned = False

    @property
    def max_distance(self) -> float:
        """Descriptors farther apart are of different places."""
        return self.settings.max_distance

    @property
    def length(self) -> int:
        """Numbers in a descriptor."""
        return self.network.settings.descriptor_size

    @property
    def row_length(self) -> int:
        """Numbers in a row."""
        return self.length

    def describe(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the descriptor [G] float32 of a sweep in the base frame.

        Raises:
            DataError: it has too few points.
        """
        return self.observe(cloud).descriptor

    def features(self, cloud: PointCloud) -> LocalFeatures:
        """Return keypoints and features; of the sweep described last they are there already."""
        return self.observe(cloud).local

    @torch.inference_mode()
    def observe(self, cloud: PointCloud) -> SweepFeatures:
        """Return descriptor and features of a sweep in the base frame, from one pass.

        Raises:
            DataError: it has too few points.
        """
        last = self._last  # another thread may be at work
        if last is not None and last[0] is cloud:
            return last[1]
        seen = thinned(cloud.finite())
        if len(seen) < _LEAST_POINTS:
            raise DataError(
                f'LCDNet needs a sweep of at least {_LEAST_POINTS} points within its reach, '
                f'got {len(seen)}'
            )
        xyz = torch.from_numpy(np.ascontiguousarray(seen.xyz, np.float32)).to(self.device)
        light = self._intensity(seen)
        given = None if light is None else [torch.from_numpy(light).to(self.device)]
        out = self.network(Clouds.of([xyz], given))
        observed = SweepFeatures(
            out.descriptors[0].float().cpu().numpy(),
            LocalFeatures(
                out.keypoints[0].float().cpu().numpy(),
                out.features[0].to(torch.float16).cpu().numpy(),
            ),
            out.left_out,
        )
        self._last = cloud, observed
        return observed

    def row(self, descriptor: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the descriptor; raises DataError on another length."""
        return self._metric.row(descriptor)

    def compare(
        self, query: NDArray[np.float32], rows: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], None]:
        """Return the L2 distances [N]; the descriptor holds no yaw."""
        return self._metric.compare(query, rows)

    def _intensity(self, cloud: PointCloud) -> NDArray[np.float32] | None:
        full = self.settings.full_intensity
        if cloud.intensity is None or full <= 0.0:
            return None
        share = np.nan_to_num(np.asarray(cloud.intensity, np.float32) / np.float32(full))
        if float(np.mean(share > 1.0)) <= 0.05:
            return np.clip(share, 0.0, 1.0)
        if not self._warned:
            self._warned = True
            _logger.warning(
                'intensities up to %g are not 0 to %g: LCDNet does without; set full_intensity to '
                "the sensor's largest",
                float(np.nanmax(cloud.intensity)),
                full,
            )
        return None


def _load(weights: str, device: torch.device) -> Lcdnet:
    path = Path(weights) if weights else PACKAGED
    if not path.is_file():
        advice = (
            'check the path'
            if weights
            else 'train them with train_lcdnet and name the file, or choose another detector'
        )
        raise ConfigError(f'{path}: expected the weights of LCDNet, found none; {advice}')
    try:
        network, _ = load_network(path, device)
    except DataError as error:
        # Of a network of another shape torch names every tensor.
        raise DataError(
            f'{str(error).splitlines()[0][:300]}; name the best.safetensors of train_lcdnet'
        ) from None
    return network
