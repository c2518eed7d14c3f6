"""Tell ensembles apart by their weights."""

import hashlib
from collections.abc import Iterable

from torch import nn


def weights_hash(members: Iterable[nn.Module]) -> str:
    """Return the SHA-256 of names and values of all weights, in the order of the members.

    The same whether they were loaded from one file or several, on a CPU or a GPU.
    """
    digest = hashlib.sha256()
    for member in members:
        for name, tensor in sorted(member.state_dict().items()):
            digest.update(name.encode())
            digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
