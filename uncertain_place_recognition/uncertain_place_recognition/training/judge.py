"""Validate a network in training, keep the best one with its card, and draw the curves."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from uncertain_place_recognition.ensemble import BEST
from uncertain_place_recognition.networks.embedding import PlaceNetwork
from uncertain_place_recognition.networks.weights import save_networks
from uncertain_place_recognition.runs import SubmapRun
from uncertain_place_recognition.training.curves import draw_curves, rows
from uncertain_place_recognition.training.embedded_runs import embed_runs
from uncertain_place_recognition.training.validation import RADIUS_M, recall


@dataclass(frozen=True)
class Judgement:
    """How a network does on validation runs.

    Attributes:
        recall_1: on its own map.
        queries: that it was asked.
        teacher_recall_1: on the teacher's map; None without a teacher.
        gap: mean distance to the teacher's embeddings, in those of a submap to the mean of all.
    """

    step: int
    recall_1: float
    queries: int
    teacher_recall_1: float | None = None
    gap: float | None = None

    @property
    def score(self) -> float:
        """What the best network has most of: recall, or with a teacher nearness to it."""
        return self.recall_1 if self.gap is None else -self.gap


class Judge:
    """Judge one training; the best network is best.safetensors, its card best.json."""

    def __init__(
        self,
        folder: Path,
        runs: Sequence[SubmapRun],
        facts: dict[str, Any],
        teacher: PlaceNetwork | None = None,
        device: torch.device | str = 'cpu',
        radius: float = RADIUS_M,
    ) -> None:
        """Take a folder, runs to validate on, facts for the card, a teacher, and what is near."""
        self.folder, self._runs, self._device, self._radius = folder, runs, device, radius
        self._facts = {**facts, 'validation_radius_m': radius}
        self._targets: list[NDArray[np.float32]] | None = None
        if teacher is not None:
            self._targets = embed_runs(teacher.to(device), runs, device)

    def judge(self, network: PlaceNetwork, step: int) -> Judgement:
        """Validate a network after a step; keep it if it is the best one so far."""
        found = self._judged(network, step)
        log = self.folder / 'validation.jsonl'
        best = max((float(row['score']) for row in rows(log)), default=float('-inf'))
        with log.open('a') as file:
            file.write(json.dumps({**vars(found), 'score': found.score}) + '\n')
        if found.score > best:
            facts = {**self._facts, 'validation': vars(found)}
            save_networks(self.folder / BEST, [network], facts)
            card = json.dumps(facts, indent=1)
            (self.folder / 'best.json').write_text(card + '\n')
        draw_curves(self.folder)
        return found

    def _judged(self, network: PlaceNetwork, step: int) -> Judgement:
        mine = embed_runs(network, self._runs, self._device)
        own = recall(self._runs, mine, mine, self._radius)
        if self._targets is None:
            return Judgement(step, own.recall_1, own.queries)
        theirs = recall(self._runs, self._targets, mine, self._radius)
        target = np.concatenate(self._targets)
        apart = np.linalg.norm(np.concatenate(mine) - target, axis=1).mean()
        spread = np.linalg.norm(target - target.mean(axis=0), axis=1).mean()
        gap = float(apart / max(float(spread), 1e-12))
        return Judgement(step, own.recall_1, own.queries, theirs.recall_1, gap)
