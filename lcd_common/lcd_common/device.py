"""Choose where networks run."""

import torch

from lcd_common.errors import ConfigError


def choose_device(name: str = 'auto') -> torch.device:
    """Return the device of a name; `auto` is the first CUDA device, else the CPU.

    Raises:
        ConfigError: there is no such device.
    """
    if name == 'auto':
        return torch.device('cuda' if torch.cuda.is_available() else 'cpu')
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigError(f'device must be auto, cpu or cuda[:N], got {name!r}') from None
    if device.type == 'cuda' and not torch.cuda.is_available():
        raise ConfigError(f'device {name} is not there: torch sees no CUDA device; use auto or cpu')
    if device.type == 'cuda' and (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f'device {name} is not there: {torch.cuda.device_count()} CUDA devices')
    return device
