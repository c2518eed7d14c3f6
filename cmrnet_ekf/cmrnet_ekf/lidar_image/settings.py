"""Say how a LiDAR image is made."""

from lcd_common.settings import config, setting


@config
class LidarImageConfig:
    """How a map becomes an image; the filter's defaults are CMRNet's (the best it published)."""

    min_depth: float = setting(0.5, 'nearer points are left out', unit='m', low=0.01)
    max_depth: float = setting(100.0, 'farther points are left out', unit='m', low=1.0)
    radius: int = setting(
        5, 'of the window in which the occlusion filter looks; 0: no filter', unit='px', low=0,
        high=30,
    )  # fmt: skip
    threshold: float = setting(
        3.0,
        'a pixel is hidden when its four quadrants cover at least that much, at most 4',
        low=-4.0,
        high=4.0,
    )
