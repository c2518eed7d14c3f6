"""Shape of the network: the thesis's and a compact one for two CPU cores."""

from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting

BACKBONES = ('pv_rcnn', 'pointnet', 'edgeconv', 'randla')
POSE_HEADS = ('uot', 'mlp_sincos', 'mlp_quaternion', 'mlp_bingham')


@config
class LcdnetConfig:
    """What the network is made of; the defaults are the thesis's (section 3.3.2).

    Clouds come in the base frame: x forward, z up, z = 0 on the ground.
    """

    backbone: str = setting('pv_rcnn', 'makes the features of keypoints', choices=BACKBONES)
    pose_head: str = setting('uot', 'estimates the relative pose', choices=POSE_HEADS)
    voxel: float = setting(0.1, 'edge of a voxel', unit='m', low=0.02, high=5.0)
    reach: float = setting(70.4, 'half the edge of the square that is seen', unit='m', low=5.0)
    # What the authors' code runs is -3 .. 1 m from the sensor, which KITTI mounts at 1.73 m; the
    # paper's text has the signs the other way round.
    z_low: float = setting(-1.3, 'lowest height that is seen', unit='m')
    z_high: float = setting(2.7, 'greatest height that is seen', unit='m')
    max_voxels: int = setting(
        60000, 'voxels of one cloud; those beyond are left out at random and counted', low=100
    )
    relative_input: bool = setting(
        False,
        'voxels tell where in them and how high their points lie, not where they are in the sweep',
    )
    use_intensity: bool = setting(True, 'see the intensity of points')
    channels: tuple[int, ...] = setting((16, 32, 64, 64), 'of the four levels 1x 2x 4x 8x')
    blocks: tuple[int, ...] = setting((2, 2, 2, 2), 'submanifold convolutions of the four levels')
    covered: bool = setting(
        True, 'coarser levels have every voxel that a tap reaches, else only occupied cells'
    )
    bev_channels: int = setting(128, 'of each of the layers of the view from above', low=1)
    group_source: tuple[int, ...] = setting(
        (0, 0, 1, 1, 2, 2, 3, 3, 4, 4), 'abstracted around keypoints: 0 points, 1 to 4 levels'
    )
    group_radius: tuple[float, ...] = setting(
        (0.4, 0.8, 0.4, 0.8, 0.8, 1.2, 1.2, 2.4, 2.4, 4.8), 'of the balls', unit='m'
    )
    group_count: tuple[int, ...] = setting(
        (16, 16, 16, 16, 16, 32, 16, 32, 16, 32), 'neighbours taken from a ball'
    )
    group_width: tuple[int, ...] = setting(
        (16, 16, 16, 16, 32, 32, 64, 64, 64, 64), 'numbers that a ball is abstracted to'
    )
    keypoints: int = setting(4096, 'N: keypoints of a cloud', low=16)
    keypoint_height: float = setting(
        0.0, 'keypoints lie at least this high above the ground below; 0: anywhere', unit='m', low=0
    )
    feature_size: int = setting(640, 'D: numbers of a keypoint feature', low=4)
    clusters: int = setting(64, 'K: clusters of NetVLAD', low=2)
    descriptor_size: int = setting(256, 'G: numbers of the descriptor', low=4)
    place_ranges: int = setting(
        0,
        'rings of distance from the sensor by which the descriptor tells keypoints apart; 0: none, '
        'as in the thesis',
        low=0,
    )
    sinkhorn_iterations: int = setting(5, 'L of Algorithm 1', low=1)

    @property
    def levels(self) -> int:
        """Number of levels, each half as fine as the one before."""
        return len(self.channels)

    def check(self) -> 'LcdnetConfig':
        """Return this configuration; raises ConfigError when its tables do not fit together."""
        rows = {
            len(getattr(self, f'group_{name}')) for name in ('source', 'radius', 'count', 'width')
        }
        if len(rows) != 1:
            raise ConfigError(
                'group_source, group_radius, group_count and group_width need one row each'
            )
        if len(self.channels) != 4 or len(self.blocks) != 4:
            raise ConfigError('channels and blocks need four numbers, one for each level')
        if any(not 0 <= source <= 4 for source in self.group_source):
            raise ConfigError('group_source is 0 (points) or 1 to 4 (levels)')
        if self.place_ranges == 1:
            raise ConfigError('place_ranges is 0 (none) or at least 2 rings')
        if self.z_high <= self.z_low:
            raise ConfigError('z_high must be above z_low')
        return self


FULL = LcdnetConfig()
COMPACT = LcdnetConfig(
    voxel=0.5,
    reach=50.0,
    z_low=-2.0,
    z_high=10.0,
    max_voxels=20000,
    relative_input=True,
    channels=(24, 32, 48, 64),
    blocks=(1, 1, 2, 2),
    covered=False,
    bev_channels=16,
    group_source=(1, 2, 3, 4),
    group_radius=(1.3, 2.5, 5.0, 9.0),
    group_count=(16, 16, 16, 16),
    group_width=(32, 32, 48, 48),
    keypoints=1024,
    keypoint_height=0.4,
    feature_size=128,
    clusters=64,
    descriptor_size=256,
)
