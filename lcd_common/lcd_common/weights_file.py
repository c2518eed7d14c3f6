"""Keep tensors, networks and the state of training in safetensors: nothing is unpickled."""

import errno
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from lcd_common.errors import DataError


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


def read(
    path: Path, device: torch.device | str = 'cpu', *, writer: str = 'a training of this suite'
) -> Stored:
    """Read a file of weights; `writer` is the command that writes such.

    Raises:
        FileNotFoundError: there is none.
        DataError: it holds other things.
    """
    try:
        with safe_open(path, 'pt', device=str(device)) as file:
            names = list(file.keys())
            facts = json.loads((file.metadata() or {})['facts'])
            return Stored({name: file.get_tensor(name) for name in names}, facts)
    except FileNotFoundError as error:
        # The library's own names no file, and commands tell people which one is missing.
        raise FileNotFoundError(
            errno.ENOENT, f'no such file; expected weights that {writer} wrote', str(path)
        ) from error
    except Exception as error:
        raise DataError(
            f'{path} holds no weights of this suite ({error}); expected a .safetensors file that '
            f'{writer} wrote'
        ) from error


def weights_of(network: nn.Module, *, half: bool = False) -> dict[str, Tensor]:
    """Return the tensors of a network, in half precision if asked."""
    return {
        name: tensor.half() if half and tensor.is_floating_point() else tensor
        for name, tensor in network.state_dict().items()
    }


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
