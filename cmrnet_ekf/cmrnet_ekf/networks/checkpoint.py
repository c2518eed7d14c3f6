"""Keep CMRNet with its configuration in a file of weights."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.config import CmrnetConfig
from lcd_common.errors import ConfigError, DataError
from lcd_common.settings import from_mapping
from lcd_common.weights_file import read, weights_of, write


def save_network(path: Path, network: Cmrnet, facts: dict[str, Any], half: bool = False) -> None:
    """Write a network with its configuration, in half precision if asked."""
    write(path, weights_of(network, half=half), {**facts, 'config': asdict(network.settings)})


def load_network(path: Path, device: torch.device | str = 'cpu') -> tuple[Cmrnet, dict[str, Any]]:
    """Return the network of a file, ready to use, and the facts beside it.

    Raises:
        DataError: the file holds none, or tensors do not fit the configuration.
    """
    stored = read(path, device, writer='train_cmrnet')
    try:
        given = stored.facts['config']
        settings = from_mapping(
            CmrnetConfig, {k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}
        )
        network = Cmrnet(settings)
        network.load_state_dict({name: value.float() for name, value in stored.tensors.items()})
    except (KeyError, TypeError, AttributeError, RuntimeError, ConfigError) as error:
        raise DataError(f'{path}: the weights do not fit the network: {error}') from error
    return network.to(device).eval(), stored.facts
