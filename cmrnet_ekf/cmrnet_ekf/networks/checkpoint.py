"""Keep networks and the state of training in safetensors: nothing is unpickled."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from cmrnet_ekf.networks.cmrnet import Cmrnet
from cmrnet_ekf.networks.config import CmrnetConfig
from lcd_common.errors import ConfigError, DataError
from lcd_common.settings import from_mapping


@dataclass(frozen=True)
class Stored:
    """What a file of weights holds: tensors by name, and facts as JSON."""

    tensors: dict[str, Tensor]
    facts: dict[str, Any]


def write(path: Path, tensors: dict[str, Tensor], facts: dict[str, Any]) -> None:
    """Write tensors and facts; a crash leaves the file of before."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix('.part')
    whole = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    save_file(whole, part, {'facts': json.dumps(facts)})
    part.replace(path)


def read(path: Path, device: torch.device | str = 'cpu') -> Stored:
    """Read a file of weights; raises DataError when it is none."""
    try:
        with safe_open(path, 'pt', device=str(device)) as file:
            names = list(file.keys())
            facts = json.loads((file.metadata() or {})['facts'])
            return Stored({name: file.get_tensor(name) for name in names}, facts)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise DataError(
            f'{path} holds no weights of this package ({error}); expected a .safetensors file that '
            'train_cmrnet wrote'
        ) from error


def save_network(path: Path, network: Cmrnet, facts: dict[str, Any], half: bool = False) -> None:
    """Write a network with its configuration, in half precision if asked."""
    tensors = {
        name: tensor.half() if half and tensor.is_floating_point() else tensor
        for name, tensor in network.state_dict().items()
    }
    write(path, tensors, {**facts, 'config': asdict(network.settings)})


def load_network(path: Path, device: torch.device | str = 'cpu') -> tuple[Cmrnet, dict[str, Any]]:
    """Return the network of a file, ready to use, and the facts beside it.

    Raises:
        DataError: the file holds none, or tensors do not fit the configuration.
    """
    stored = read(path, device)
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


def train_state(module: nn.Module, optimizer: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Return all tensors that resuming needs."""
    tensors = {f'network.{name}': value for name, value in module.state_dict().items()}
    for number, state in optimizer.state_dict()['state'].items():
        tensors |= {f'adam.{number}.{name}': value for name, value in state.items()}
    return tensors


def restore(
    module: nn.Module, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]
) -> None:
    """Put back what `train_state` returned."""
    parts: dict[str, dict[str, Tensor]] = {'network': {}, 'adam': {}}
    for key, value in tensors.items():
        kind, name = key.split('.', 1)
        parts[kind][name] = value
    module.load_state_dict(parts['network'])
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in parts['adam'].items():
        number, name = key.split('.', 1)
        state.setdefault(int(number), {})[name] = value
    optimizer.load_state_dict({**optimizer.state_dict(), 'state': state})
