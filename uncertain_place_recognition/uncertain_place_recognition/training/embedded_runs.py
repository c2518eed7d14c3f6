"""Embed whole runs, in batches."""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from uncertain_place_recognition.networks.embedding import PlaceNetwork
from uncertain_place_recognition.runs import SubmapRun


def embed_run(
    network: PlaceNetwork, run: SubmapRun, device: torch.device | str = 'cpu', batch: int = 16
) -> NDArray[np.float32]:
    """Return embeddings [N x D] of a run's submaps; the network is left in the mode it was in."""
    was_training = network.training
    network.eval()
    with torch.inference_mode():
        found = [
            network.embed(points_of(run.points[begin : begin + batch], device)).cpu().numpy()
            for begin in range(0, len(run), batch)
        ]
    network.train(was_training)
    return np.concatenate(found)


def points_of(points: NDArray[np.float16], device: torch.device | str) -> torch.Tensor:
    """Return submaps [B x P x 3] as float32 on a device."""
    return torch.from_numpy(np.ascontiguousarray(points)).to(device).float()


def thinned_run(run: SubmapRun, most: int) -> SubmapRun:
    """Return a run with at most so many submaps, evenly spread."""
    if len(run) <= most:
        return run
    return run.select(np.arange(most) * len(run) // most)


def embed_runs(
    network: PlaceNetwork, runs: Sequence[SubmapRun], device: torch.device | str = 'cpu'
) -> list[NDArray[np.float32]]:
    """Return embeddings [N x D] of every run."""
    return [embed_run(network, run, device) for run in runs]
