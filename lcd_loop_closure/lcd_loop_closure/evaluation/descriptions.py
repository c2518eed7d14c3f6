"""Describe the sweeps of a drive by a method, once."""

import hashlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud
from lcd_loop_closure.descriptor_index import Metric
from lcd_loop_closure.evaluation.sweep_views import Sweeps


class SweepDescriptor(Metric, Protocol):
    """How sweeps are described and compared; `name` is what files are called."""

    name: str

    def describe(self, cloud: PointCloud) -> NDArray[np.float32]:
        """Return the descriptor of a sweep in the base frame."""


@dataclass(frozen=True)
class Descriptions:
    """Descriptors of a drive.

    Attributes:
        rows: [N x row_length] float32, what an index stores.
        describe_ms: [N] time to make each.
    """

    rows: NDArray[np.float32]
    describe_ms: NDArray[np.float64]


def describe_sweeps(
    descriptor: SweepDescriptor,
    sweeps: Sweeps,
    *,
    folder: Path | None = None,
    key: str = '',
    progress: Callable[[], None] = lambda: None,
) -> Descriptions:
    """Return the descriptors of all sweeps.

    Args:
        descriptor: the method.
        sweeps: to describe.
        folder: where descriptors are kept and looked for; None keeps none.
        key: names everything that the descriptors depend on besides method and sweeps.
        progress: called after each sweep.
    """
    number = len(sweeps.T_world_base)
    path = None
    if folder is not None:
        # Drives of one name differ by where they went.
        identity = hashlib.sha256(f'{key}|'.encode() + sweeps.T_world_base.tobytes()).hexdigest()
        path = folder / f'{sweeps.name}-{descriptor.name}-{identity[:12]}.npz'
        if path.is_file():
            with np.load(path) as kept:
                return Descriptions(kept['rows'], kept['describe_ms'])
    rows = np.empty((number, descriptor.row_length), np.float32)
    describe_ms = np.empty(number)
    for k in range(number):
        cloud = sweeps.cloud(k)
        start = time.perf_counter()
        rows[k] = descriptor.row(descriptor.describe(cloud))
        describe_ms[k] = 1e3 * (time.perf_counter() - start)
        progress()
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f'part-{path.name}')
        np.savez(part, rows=rows, describe_ms=describe_ms)
        part.replace(path)
    return Descriptions(rows, describe_ms)
