"""Settings of LCDNet as a detector; apart, so that nodes declare them without loading torch."""

from lcd_common.settings import config, setting


@config
class LcdnetDescriptorConfig:
    """Which network, and where it runs."""

    weights: str = setting('', 'file of train_lcdnet; empty: the compact one that ships')
    device: str = setting('auto', 'auto (a GPU where there is one), cpu, cuda or cuda:N')
    threads: int = setting(
        1,
        'of torch in this process; more fight with other busy processes for the cores; 0: all',
        low=0,
    )
    max_distance: float = setting(
        0.9, 'candidates that look less alike are not registered', low=0.0
    )
    full_intensity: float = setting(
        1.0, 'intensity of the brightest return; 0: the sensor has none', low=0.0
    )
