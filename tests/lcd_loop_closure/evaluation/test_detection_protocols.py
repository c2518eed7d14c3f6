"""Protocol 1 against its definition, counted threshold by threshold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lcd_loop_closure.evaluation.detection_protocols import candidates, protocol_1
from lcd_loop_closure.revisits import RevisitConfig

SETTINGS = RevisitConfig(first_scan=10, excluded_scans=5)


def noisy_drive(noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Two rounds about a circle; descriptors are positions with noise."""
    rng = np.random.default_rng(0)
    angle = np.linspace(0.0, 4 * np.pi, 240)
    positions = 60.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.0 * angle])
    return positions, positions + rng.normal(0.0, noise, positions.shape)


def by_definition(positions: np.ndarray, descriptors: np.ndarray) -> float:
    found = []
    for i in range(10, len(positions)):
        d = np.linalg.norm(descriptors[: i - 5] - descriptors[i], axis=1)
        near = np.linalg.norm(positions[: i - 5] - positions[i], axis=1) <= 4.0
        found.append((d.min(), near[d.argmin()], near.any()))
    precision, recall = [], []
    for threshold in sorted({row[0] for row in found}):
        tp = sum(d <= threshold and loop and right for d, right, loop in found)
        fp = sum(d <= threshold and not right for d, right, loop in found)
        fn = sum(d > threshold and loop for d, right, loop in found)
        precision.append(tp / (tp + fp) if tp + fp else 1.0)
        recall.append(tp / (tp + fn) if tp + fn else 0.0)
    return sum((recall[k] - recall[k - 1]) * precision[k] for k in range(1, len(recall)))


@pytest.mark.parametrize('noise', [0.0, 2.0, 8.0, 40.0])
def test_average_precision_is_that_of_the_definition(noise: float) -> None:
    positions, descriptors = noisy_drive(noise)
    found = candidates(
        lambda i, m: np.linalg.norm(descriptors[:m] - descriptors[i], axis=1), positions, SETTINGS
    )
    curve = protocol_1(found)
    assert curve.average_precision == pytest.approx(by_definition(positions, descriptors))
    assert curve.loops == 120 + 1
    if not noise:
        assert curve.average_precision > 0.98


def test_too_short_a_drive_has_no_candidates() -> None:
    found = candidates(lambda i, m: np.zeros(m), np.zeros((8, 3)), SETTINGS)
    assert len(found.query) == 0
    curve = protocol_1(found)
    assert curve.average_precision == 0.0 and curve.loops == 0


def test_a_scan_without_a_candidate_is_a_missed_loop_whatever_the_threshold() -> None:
    positions, descriptors = noisy_drive(8.0)
    found = candidates(
        lambda i, m: np.linalg.norm(descriptors[:m] - descriptors[i], axis=1), positions, SETTINGS
    )
    without = np.arange(len(found)) % 3 == 0
    distance = np.where(without, np.inf, found.distance)
    curve = protocol_1(replace(found, distance=distance, right=found.right & ~without))
    rejected = np.sum(found.loop & without)
    right = np.sum(found.right & ~without)
    assert curve.recall[-1] == pytest.approx(right / (right + rejected))
    assert np.isfinite(curve.threshold).all()
