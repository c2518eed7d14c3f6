"""Fill a bag with a little of everything."""

import numpy as np

START_NS = 1_700_000_000 * 10**9


def of(kind, drive):
    return [r for r in drive.records() if isinstance(r, kind)]


def fill(bag, points_of, count=6):
    """Record a little of everything: `count` sweeps at 10 Hz and the rest with them."""
    bag.mounting(START_NS, 'velodyne', 1.7)
    for n in range(count):
        stamp = START_NS + n * 10**8
        bag.imu(stamp, float(n))
        bag.fix(stamp, 49.0 + 0.001 * n)
        bag.pose(stamp, float(n))
        bag.image(stamp, np.full((4, 6, 3), (n, 20, 30), np.uint8), 'rgb8')
        bag.cloud(stamp, points_of(n))
