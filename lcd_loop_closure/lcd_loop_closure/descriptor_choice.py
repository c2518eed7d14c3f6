"""Make the place descriptor that the settings name."""

from lcd_common.settings import config, setting
from lcd_loop_closure.descriptor_index import PlaceDescriptor
from lcd_loop_closure.lcdnet_settings import LcdnetDescriptorConfig
from lcd_loop_closure.scan_context import ScanContext, ScanContextConfig


@config
class DescriptorConfig:
    """Which descriptor finds loops."""

    method: str = setting(
        'lcdnet',
        'lcdnet: learnt, also registers; scan_context: hand-crafted, needs no torch',
        choices=('lcdnet', 'scan_context'),
    )


def make_descriptor(
    choice: DescriptorConfig, lcdnet: LcdnetDescriptorConfig, scan_context: ScanContextConfig
) -> PlaceDescriptor:
    """Return the chosen descriptor.

    Raises:
        ConfigError: LCDNet's weights or device are not there.
        DataError: the file of weights holds other things.
    """
    if choice.method == 'scan_context':
        return ScanContext(scan_context)
    from lcd_loop_closure.lcdnet_descriptor import LcdnetDescriptor  # torch takes seconds

    return LcdnetDescriptor(lcdnet)
