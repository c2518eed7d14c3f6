"""Keep networks in safetensors, one or all members of an ensemble in one file; no pickle."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from lcd_common.errors import DataError, LocalizationError
from lcd_common.weights_file import read, write
from uncertain_place_recognition.networks.embedding import PlaceNetwork
from uncertain_place_recognition.networks.shapes import build, name_of, settings_from


def save_networks(
    path: Path, networks: Sequence[PlaceNetwork], facts: dict[str, Any], *, half: bool = False
) -> None:
    """Write networks of one shape with facts, matrices in half precision if asked.

    Raises:
        DataError: there is none, or their shapes differ.
    """
    shapes = [network.settings for network in networks]
    if not shapes or any(one != shapes[0] for one in shapes):
        raise DataError(f'{path}: expected networks of one shape, got {len(set(shapes))} shapes')
    tensors = {
        f'{number}.{name}': tensor.half() if half and tensor.ndim > 1 else tensor
        for number, network in enumerate(networks)
        for name, tensor in network.state_dict().items()
    }
    told = {'network': name_of(shapes[0]), 'config': asdict(shapes[0]), 'members': len(shapes)}
    write(path, tensors, {**facts, **told})


def load_networks(
    path: Path, device: torch.device | str = 'cpu'
) -> tuple[list[PlaceNetwork], dict[str, Any]]:
    """Return the networks of a file, ready to use, and the facts beside them.

    Raises:
        DataError: the file holds none, or tensors do not fit the configuration.
    """
    if not path.is_file():
        raise DataError(f'{path}: no such file of weights; train_place_recognition makes them')
    try:
        stored = read(path, device)
    except DataError as error:
        raise DataError(f'{path} holds no weights for places: {error.__cause__ or error}') from None
    try:
        facts = stored.facts
        settings = settings_from(facts['network'], facts['config'])
        members: list[dict[str, Tensor]] = [{} for _ in range(int(facts['members']))]
        for key, tensor in stored.tensors.items():
            number, _, name = key.partition('.')
            members[int(number)][name] = tensor.float() if tensor.is_floating_point() else tensor
        networks = [build(settings) for _ in members]
        for network, tensors in zip(networks, members, strict=True):
            network.load_state_dict(tensors)
    except (KeyError, TypeError, ValueError, IndexError, RuntimeError, LocalizationError) as error:
        raise DataError(f'{path}: the weights do not fit a network for places: {error}') from error
    return [network.to(device).eval() for network in networks], facts
