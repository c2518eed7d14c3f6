"""Shape of the network: CMRNet's and a compact one for two CPU cores."""

from dataclasses import replace

from lcd_common.errors import ConfigError
from lcd_common.settings import config, setting

HEADS = ('quaternion', 'evidential', 'covariance')


@config
class CmrnetConfig:
    """What the network is made of and what images it takes; the defaults are CMRNet's."""

    head: str = setting(
        'quaternion',
        'quaternion: CMRNet; evidential: a normal-inverse-gamma distribution of each component; '
        'covariance: a Gaussian with all correlations',
        choices=HEADS,
    )
    dropout: float = setting(
        0.0, 'share of inputs dropped before each FC layer (thesis, for MCD: 0.3)', low=0, high=0.9
    )
    width: int = setting(1280, 'of the images', unit='px', low=32)
    height: int = setting(384, 'of the images', unit='px', low=32)
    focal: float = setting(
        0.0, 'images are scaled so that fx becomes about that; 0: not scaled', unit='px', low=0.0
    )
    centred: bool = setting(
        False, 'move the principal point into the middle; else pad right and below'
    )
    occlusion_radius: int = setting(5, 'of the window of the occlusion filter', unit='px', low=0)
    occlusion_threshold: float = setting(3.0, 'of the occlusion filter', low=-4.0, high=4.0)
    max_depth: float = setting(100.0, 'depth that the network sees as 1', unit='m', low=1.0)
    pyramid: tuple[int, ...] = setting(
        (16, 32, 64, 96, 128, 196), 'channels of the levels, each half as fine as the one before'
    )
    convolutions: int = setting(3, 'of a level', low=1, high=5)
    standardised: bool = setting(
        False,
        'features of a cell get mean 0, variance 1 before they are correlated (not in CMRNet); '
        'a correlation then says how alike cells are from the first batch on',
    )
    displacement: int = setting(4, 'cells that the correlation looks to each side', low=1, high=10)
    flow_sharpness: float = setting(
        0.0,
        'the estimator also sees where a softmax of the correlation times this finds each cell, '
        'and how far away it is (not in CMRNet); 0: it does not',
        low=0.0,
    )
    estimator: tuple[int, ...] = setting(
        (128, 128, 96, 64, 32), 'channels that the layers after the correlation add'
    )
    squeezed: int = setting(0, 'channels before the FC layers; 0: all', low=0)
    pooled_rows: int = setting(0, 'rows that the FC layers see; 0: all', low=0)
    pooled_columns: int = setting(0, 'columns that the FC layers see; 0: all', low=0)
    hidden: int = setting(512, 'size of the first FC layer', low=4)
    branch: int = setting(256, 'size of the layer before each output', low=4)

    def check(self) -> 'CmrnetConfig':
        """Return this configuration; raises ConfigError when its numbers do not fit together."""
        step = 2 ** len(self.pyramid)
        if not self.pyramid or self.width % step or self.height % step:
            raise ConfigError(
                f'{len(self.pyramid)} levels need a width and height that divide by {step}, '
                f'got {self.width} x {self.height}'
            )
        if bool(self.pooled_rows) != bool(self.pooled_columns):
            raise ConfigError('pooled_rows and pooled_columns belong together; 0 is all, of both')
        return self

    @property
    def images(self) -> tuple[float, ...]:
        """What says which images the network sees: size, scale and place, filter, depth."""
        filter_ = self.occlusion_radius, self.occlusion_threshold
        return self.width, self.height, self.focal, self.centred, *filter_, self.max_depth

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns of the last level."""
        step = 2 ** len(self.pyramid)
        return self.height // step, self.width // step


FULL = CmrnetConfig()
# A third of KITTI's images. Four levels leave cells of 16 px: 48 px of the original image, so that
# the correlation's reach is what a turn by 10 degrees moves and a half.
COMPACT = CmrnetConfig(
    width=416,
    height=128,
    focal=239.6,
    centred=True,
    occlusion_radius=3,
    pyramid=(16, 24, 40, 64),
    convolutions=2,
    standardised=True,
    estimator=(64, 48, 48, 32, 32),
    squeezed=24,
    pooled_rows=4,
    pooled_columns=13,
    hidden=256,
    branch=64,
)
# For the second and third network of a refinement: cells half as large, as guesses are nearer.
COMPACT_FINE = replace(COMPACT, pyramid=(16, 24, 40), flow_sharpness=10.0)
