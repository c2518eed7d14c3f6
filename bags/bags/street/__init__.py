"""Drive through an analytic town block, for demos without data, for tests and for benchmarks."""

from bags.street.drive import StreetConfig, StreetDrive
from bags.street.lidar import LidarConfig
from bags.street.route import Route, abrupt_u_turn, loop

__all__ = ['LidarConfig', 'Route', 'StreetConfig', 'StreetDrive', 'abrupt_u_turn', 'loop']
