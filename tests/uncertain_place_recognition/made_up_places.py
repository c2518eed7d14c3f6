"""Places that can be told apart, and an ensemble that does: no training, and every answer known."""

from typing import Any

import numpy as np

from lcd_common import se3
from lcd_common.cloud import PointCloud
from uncertain_place_recognition.acceptance import Acceptance
from uncertain_place_recognition.drift_alarm import DriftReference
from uncertain_place_recognition.match_probability import MatchModel
from uncertain_place_recognition.place_recognizer import PlaceRecognizer
from uncertain_place_recognition.trust import Calibration

SPACING_M = 30.0
LENGTH = 16


def cloud_of(number: int, noise: float = 0.01, count: int = 400) -> PointCloud:
    """Return what is seen at a place; `noise` in metres, other noise each time."""
    rng = np.random.default_rng(number)
    xyz = rng.uniform([-20, -20, 0.5], [20, 20, 5], (count, 3))
    xyz += np.random.default_rng([number, int(noise * 1e6)]).normal(0, noise, xyz.shape)
    return PointCloud(xyz.astype(np.float32))


def pose_of(number: int) -> np.ndarray:
    """Return T_map_base of a place: they lie in a row."""
    return se3.from_rotation_translation(np.eye(3), [SPACING_M * number, 0.0, 0.0])


class Submaps:
    """Takes the points as they are."""

    def make(self, cloud: PointCloud) -> np.ndarray:
        from lcd_common.errors import DataError

        if len(cloud) < 50:
            raise DataError(f'expected at least 50 points, got {len(cloud)}')
        return cloud.xyz


class Ensemble:
    """Random features of the histogram of a cloud; members disagree as much as is asked for."""

    def __init__(self, disagreement: float = 0.02, members: int = 5, seed: int = 0) -> None:
        self.disagreement, self.size, self.length = disagreement, members, LENGTH
        self._mix = np.random.default_rng(seed).normal(size=(64, LENGTH))

    def embed(self, points: np.ndarray) -> np.ndarray:
        edges = np.linspace(-20, 20, 9)
        counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=(edges, edges))
        whole = (counts.ravel() / len(points) - 1 / 64) @ self._mix
        rng = np.random.default_rng(int(abs(whole).sum() * 1e6))
        spread = self.disagreement * np.linalg.norm(whole) / np.sqrt(LENGTH)
        return (whole + spread * rng.normal(size=(self.size, LENGTH))).astype(np.float32)


def recognizer(judge: Any = None, ensemble: Any = None, **settings: Any) -> PlaceRecognizer:
    """Make a recognizer of these places."""
    from uncertain_place_recognition.place_recognizer import PlaceRecognizerConfig

    settings = {'delay': 0, **settings}
    return PlaceRecognizer(
        ensemble or Ensemble(),
        Submaps(),
        judge,
        PlaceRecognizerConfig(**settings),
        fingerprint='0123456789abcdef' * 4,
    )


def calibration(database_size: int = 100, threshold: float = 0.0, **options: Any) -> Calibration:
    """Return a calibration that finds matches wrong whose distance exceeds about 0.2."""
    rng = np.random.default_rng(0)
    wrong = rng.random(600) < 0.5
    distance = np.where(wrong, rng.uniform(0.2, 0.9, 600), rng.uniform(0.0, 0.2, 600))
    other = rng.random((600, 3)) * [0.01, 10.0, 0.5]
    model = MatchModel.fit(np.column_stack([distance, other]), wrong)
    acceptance = Acceptance(
        'false_match_rate', 0.05, None, threshold, 600, int(wrong.sum()), 20, database_size
    )
    drift = DriftReference(np.linspace(0.0, 0.002, 500), 5)
    return Calibration('0123456789abcdef' * 4, 'cosine', model, acceptance, drift, **options)
