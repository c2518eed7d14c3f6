"""Read which networks are judged, and under which names: NAME=FILE or NAME=FILE,FILE,..."""

import re
from collections.abc import Sequence
from pathlib import Path

import torch

from cmrnet_ekf.networks.checkpoint import load_network
from cmrnet_ekf.predictors import Predictor, weights_in
from lcd_common.errors import ConfigError

ROUGH = 'rough'  # the row of the guesses


def named_predictors(
    texts: Sequence[str], device: torch.device | str = 'cpu', samples: int = 30, seed: int = 0
) -> dict[str, Predictor]:
    """Return predictors by name, in the order given.

    Args:
        texts: NAME=PATH[,PATH...]; a path is a file of weights, a folder of a training, or a folder
            of either (an ensemble). Several files are an ensemble.
        device: where they run.
        samples, seed: draws of MC dropout.

    Raises:
        ConfigError: a text is not of that form, or a name or a file comes twice.
        DataError: a path holds no weights.
    """
    found: dict[str, Predictor] = {}
    for text in texts:
        name, equals, paths = text.partition('=')
        if not equals or not paths or not re.fullmatch(r'[a-z][a-z0-9_]*', name):
            raise ConfigError(f'{text!r}: expected NAME=FILE or NAME=FILE,FILE, e.g. der=best')
        if name in found or name == ROUGH:
            what = 'comes twice' if name in found else 'is the row of the guesses'
            raise ConfigError(f'the name {name} {what}; choose another')
        files = [file for path in paths.split(',') for file in weights_in(Path(path))]
        if len({file.resolve() for file in files}) < len(files):
            raise ConfigError(f'{name}: a file comes twice; an ensemble needs different networks')
        networks = [load_network(file, device)[0] for file in files]
        found[name] = Predictor(networks, samples, seed)
    return found
