"""Say how a map is built and loaded."""

from lcd_common.settings import config, setting


@config
class MapConfig:
    """How sweeps become a map; voxel and the box of the vehicle are CMRNet's."""

    voxel: float = setting(0.1, 'one point is kept in each voxel', unit='m', low=0.02, high=2.0)
    tile: float = setting(20.0, 'side of the tiles', unit='m', low=2.0, high=500.0)
    max_range: float = setting(
        60.0, 'points farther from the vehicle are left out', unit='m', low=1.0
    )
    vehicle: float = setting(
        3.0, 'half the side of the square around base whose points are the vehicle', unit='m', low=0
    )
    buffer: int = setting(
        4_000_000, 'points that wait in memory until they are written into tiles', low=1000
    )
    neighbours: int = setting(
        6, 'points around a point (three cells of 0.3 m each way) below which it is an outlier',
        low=0,
    )  # fmt: skip
    see_through: bool = setting(
        True, 'remove what later or earlier sweeps saw through: it has moved'
    )
    evidence_spacing: float = setting(
        1.0, 'way between sweeps that are asked what they see through', unit='m', low=0.0
    )
    evidence_range: float = setting(
        30.0, 'sweeps are asked about points up to that far', unit='m', low=1.0
    )
    evidence_votes: int = setting(3, 'sweeps that must have seen through a point', low=1)
    evidence_ratio: float = setting(
        1.0, 'points hit more often than that share of the votes against them stay', low=0.0
    )
