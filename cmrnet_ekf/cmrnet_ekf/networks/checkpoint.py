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


def begin_from(network: Cmrnet, path: Path) -> list[str]:
    """Give a network the weights of a file; its head may be another.

    Returns:
        The tensors of the head that stay as they were, because the file's have another shape.

    Raises:
        ConfigError: other layers differ, so that nothing could be taken over.
        DataError: the file holds no network.
    """
    theirs, own = load_network(path)[0].state_dict(), network.state_dict()
    fitting = {k: v for k, v in theirs.items() if k in own and own[k].shape == v.shape}
    fresh = [name for name in own if name not in fitting]
    others = [name for name in fresh if not name.startswith('head.')]
    if others:
        raise ConfigError(
            f'{path}: expected a network of the same shape but for its head, but '
            f'{others[0]} differs; give the same --network and --set'
        )
    network.load_state_dict(fitting, strict=False)
    return fresh
