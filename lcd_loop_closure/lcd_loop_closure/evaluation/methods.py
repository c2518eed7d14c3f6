"""The methods that can be evaluated, by the names that users give them."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from lcd_common.errors import ConfigError
from lcd_loop_closure.baselines.registration import CloudRegistration, RefinedRegistration
from lcd_loop_closure.evaluation.descriptions import SweepDescriptor
from lcd_loop_closure.evaluation.yaw_registration import YawRegistration
from lcd_loop_closure.scan_context import ScanContext, ScanContextConfig

DESCRIPTORS: dict[str, str] = {
    'lcdnet': 'LCDNet (thesis section 3.2)',
    'scan_context': 'Scan Context, every keyframe compared',
    'scan_context_50': 'Scan Context, the 50 nearest ring keys compared',
    'm2dp': 'M2DP',
    'isc': 'Intensity Scan Context; needs intensity',
    'lidar_iris': 'LiDAR-Iris',
}
REGISTRATIONS: dict[str, str] = {
    'lcdnet': 'what the node runs: features, refined by GICP',
    'lcdnet_accepted': 'the same, where its verification accepts',
    'lcdnet_ransac': 'LCDNet: features alone',
    'lcdnet_fast': 'LCDNet: transport head alone',
    'lcdnet_icp': 'LCDNet: features, then point-to-point ICP',
    'lcdnet_gnc': 'LCDNet: features, solved by graduated non-convexity',
    'lcdnet_kiss_matcher': "LCDNet: features, solved by KISS-Matcher's solver",
    'kiss_matcher': 'KISS-Matcher',
    'kiss_matcher_gicp': 'KISS-Matcher, then GICP',
    'fpfh_ransac': 'FPFH and RANSAC (Open3D)',
    'fgr': 'fast global registration (Open3D)',
    'icp_point_to_point': 'ICP from the identity',
    'icp_point_to_plane': 'ICP to planes from the identity',
    'small_gicp': 'GICP from the identity',
    'scan_context_yaw': 'the heading that Scan Context tells',
    'isc_yaw': 'the heading that Intensity Scan Context tells',
    'lidar_iris_yaw': 'the heading that LiDAR-Iris tells',
}


@dataclass(frozen=True)
class Method:
    """A descriptor to evaluate.

    Attributes:
        name: that users gave.
        descriptor: of sweeps.
        key: all that its descriptors depend on besides the sweeps.
    """

    name: str
    descriptor: SweepDescriptor
    key: str


class Methods:
    """Build methods by name; LCDNet is loaded once for all that use it."""

    def __init__(
        self, weights: Path | None = None, *, device: str = 'auto', full_intensity: float = 1.0
    ) -> None:
        """Take the file of LCDNet's weights (None: those that ship) and what sweeps are like."""
        self._weights, self._device, self._full = weights, device, full_intensity

    def descriptor(self, name: str) -> Method:
        """Return a descriptor.

        Raises:
            ConfigError: there is none of that name, or its weights are missing.
        """
        if name not in DESCRIPTORS:
            raise ConfigError(f'no method {name!r}; there are {", ".join(DESCRIPTORS)}')
        makers: dict[str, Callable[[], SweepDescriptor]] = {
            'lcdnet': lambda: self.lcdnet,
            'scan_context': ScanContext,
            'scan_context_50': lambda: ScanContext(ScanContextConfig(shortlist=50)),
            'm2dp': self._m2dp,
            'isc': self._isc,
            'lidar_iris': self._iris,
        }
        made = makers[name]()
        key = repr(getattr(made, 'settings', ''))
        if name == 'lcdnet':
            key += self._weights_hash()
        return Method(name, made, f'{name}|{key}')

    def registration(self, name: str) -> CloudRegistration:
        """Return a registration.

        Raises:
            ConfigError: there is none of that name, or its weights are missing.
        """
        if name not in REGISTRATIONS:
            raise ConfigError(f'no registration {name!r}; there are {", ".join(REGISTRATIONS)}')
        if name.endswith('_yaw'):
            return YawRegistration(self.descriptor(name.removesuffix('_yaw')).descriptor, name)
        if name.startswith('lcdnet'):
            return self._lcdnet_registration(name)
        return _baseline(name)

    @cached_property
    def lcdnet(self) -> Any:
        """The network."""
        from lcd_loop_closure.lcdnet_descriptor import LcdnetDescriptor
        from lcd_loop_closure.lcdnet_settings import LcdnetDescriptorConfig

        return LcdnetDescriptor(
            LcdnetDescriptorConfig(
                weights='' if self._weights is None else str(self._weights),
                device=self._device,
                full_intensity=self._full,
            )
        )

    def _lcdnet_registration(self, name: str) -> CloudRegistration:
        from lcd_loop_closure.evaluation.lcdnet_registration import (
            LcdnetFast,
            LcdnetGnc,
            LcdnetKissMatcher,
            LcdnetRansac,
            NodeRegistration,
        )

        if name == 'lcdnet_icp':
            from lcd_loop_closure.baselines.icp import Icp

            return RefinedRegistration(LcdnetRansac(self.lcdnet), Icp())
        if name == 'lcdnet_fast':
            return LcdnetFast(self.lcdnet)
        if name == 'lcdnet_ransac':
            return LcdnetRansac(self.lcdnet)
        if name == 'lcdnet_gnc':
            return LcdnetGnc(self.lcdnet)
        if name == 'lcdnet_kiss_matcher':
            return LcdnetKissMatcher(self.lcdnet)
        return NodeRegistration(self.lcdnet, accepted_only=name == 'lcdnet_accepted')

    def _weights_hash(self) -> str:
        from lcd_loop_closure.lcdnet_descriptor import PACKAGED

        path = self._weights or PACKAGED
        return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ''

    def _m2dp(self) -> SweepDescriptor:
        from lcd_loop_closure.baselines.m2dp import M2dp

        return M2dp()

    def _isc(self) -> SweepDescriptor:
        from lcd_loop_closure.baselines.intensity_scan_context import (
            IntensityScanContext,
            IntensityScanContextConfig,
        )

        return IntensityScanContext(IntensityScanContextConfig(full_intensity=self._full))

    def _iris(self) -> SweepDescriptor:
        from lcd_loop_closure.baselines.lidar_iris import LidarIris

        return LidarIris()


def _baseline(name: str) -> CloudRegistration:
    # Imported when asked for: Open3D takes seconds, and not everything is installed everywhere.
    from lcd_loop_closure.baselines.fpfh import FastGlobalRegistration, FpfhRansac
    from lcd_loop_closure.baselines.gicp import Gicp
    from lcd_loop_closure.baselines.icp import Icp, IcpConfig
    from lcd_loop_closure.baselines.kiss_matching import KissMatcher

    makers: dict[str, Callable[[], CloudRegistration]] = {
        'kiss_matcher': KissMatcher,
        'kiss_matcher_gicp': lambda: RefinedRegistration(KissMatcher(), Gicp()),
        'fpfh_ransac': FpfhRansac,
        'fgr': FastGlobalRegistration,
        'icp_point_to_point': Icp,
        'icp_point_to_plane': lambda: Icp(IcpConfig(planes=True)),
        'small_gicp': Gicp,
    }
    return makers[name]()
