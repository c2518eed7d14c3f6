"""Keep LCDNet with its configuration in a file of weights."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from lcd_common.errors import DataError
from lcd_common.weights_file import read, weights_of, write
from lcd_loop_closure.lcdnet.config import LcdnetConfig
from lcd_loop_closure.lcdnet.network import Lcdnet


def save_network(path: Path, network: Lcdnet, facts: dict[str, Any], half: bool = False) -> None:
    """Write a network with its configuration, in half precision if asked."""
    write(path, weights_of(network, half=half), {**facts, 'config': asdict(network.settings)})


def load_network(path: Path, device: torch.device | str = 'cpu') -> tuple[Lcdnet, dict[str, Any]]:
    """Return the network of a file, ready to use, and the facts beside it.

    Raises:
        DataError: the file holds none, or tensors do not fit the configuration.
    """
    stored = read(path, device, writer='train_lcdnet')
    try:
        given: dict[str, Any] = stored.facts['config']
        settings = LcdnetConfig(
            **{k: tuple(v) if isinstance(v, list) else v for k, v in given.items()}  # type: ignore[arg-type]
        )
        network = Lcdnet(settings)
        network.load_state_dict(
            {k: v.float() if v.is_floating_point() else v for k, v in stored.tensors.items()}
        )
    except (KeyError, TypeError, RuntimeError) as error:
        raise DataError(f'{path}: the weights do not fit the network: {error}') from error
    return network.to(device).eval(), stored.facts
