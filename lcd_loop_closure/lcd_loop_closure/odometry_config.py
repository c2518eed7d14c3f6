"""Settings of lidar odometry."""

from lcd_common.settings import config, setting


@config
class OdometryConfig:
    """How sweeps are registered; lengths fit a car, a robot indoors wants a smaller range."""

    max_range: float = setting(100.0, 'farther points are not used', unit='m', low=1.0)
    min_range: float = setting(
        0.0, 'nearer points (the vehicle itself) are not used', unit='m', low=0.0
    )
    voxel_size: float = setting(0.0, 'of the local map; 0 is max_range / 100', unit='m', low=0.0)
    deskew: bool = setting(True, 'undo the motion within a sweep where points carry their time')
    polish: bool = setting(
        True, "move KISS-ICP's pose onto the map's surfaces (point to plane); off: KISS-ICP alone"
    )
    threads: int = setting(
        0, 'of KISS-ICP: 0 is all, 1 repeats exactly; set by the first odometry of a process', low=0
    )
    range_noise: float = setting(
        0.02, 'standard deviation of a range', unit='m', low=0.0001, high=1.0
    )
    unseen_speed: float = setting(
        10.0, 'how wrong the speed may be where a sweep cannot tell', unit='m/s', low=0.01
    )
    unseen_turn_rate: float = setting(
        0.5, 'how wrong the turn rate may be where a sweep cannot tell', unit='rad/s', low=0.01
    )
    lost_turn: float = setting(
        1.5, 'how wrong the heading may be after a sweep that fits nowhere', unit='rad', low=0.01
    )
    min_fitness_ratio: float = setting(
        0.6, 'a sweep that fits less than this share of the usual has failed', low=0.0, high=1.0
    )
    min_fitness: float = setting(
        0.1, 'a sweep of which a smaller share fits has failed in any case', low=0.0, high=1.0
    )
    max_lost: int = setting(5, 'failed sweeps in a row after which the map starts anew', low=1)
    min_points: int = setting(100, 'a sweep with fewer usable points is refused', low=10)
