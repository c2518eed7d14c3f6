"""Say how far a match can be believed: probability, calibrated threshold, and whether both hold."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lcd_common import se3
from lcd_common.errors import ConfigError, MapError
from lcd_common.settings import from_mapping
from uncertain_place_recognition.acceptance import GROWTH, Acceptance
from uncertain_place_recognition.ambiguity import AmbiguityConfig, match_spread, second_place_ratio
from uncertain_place_recognition.drift_alarm import DriftAlarm, DriftConfig, DriftReference
from uncertain_place_recognition.match_probability import MatchFeatures, MatchModel
from uncertain_place_recognition.place import Judgement
from uncertain_place_recognition.retrieval.place_index import Neighbours

FORMAT, VERSION = 'place_calibration', 1


@dataclass(frozen=True)
class Calibration:
    """What a calibration found out about one ensemble.

    Attributes:
        ensemble: hash of its weights (`weights_hash`); nothing holds for another one.
        metric: cosine or euclidean, by which places are ranked and compared.
        model: gives probabilities.
        acceptance: gives the threshold, and what it promises.
        drift: uncertainties that the calibration saw; None where nobody watches for drift.
        ambiguity: by which matches were compared.
        spacing_m: between the places of the calibration's maps; None in files of before.
    """

    ensemble: str
    metric: str
    model: MatchModel
    acceptance: Acceptance
    drift: DriftReference | None = None
    ambiguity: AmbiguityConfig = field(default_factory=AmbiguityConfig)
    spacing_m: float | None = None

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        plain: dict[str, Any] = {
            'format': FORMAT,
            'version': VERSION,
            'ensemble': self.ensemble,
            'metric': self.metric,
            'acceptance': self.acceptance.plain(),
            'drift': None if self.drift is None else self.drift.plain(),
            'ambiguity': asdict(self.ambiguity),
            'spacing_m': self.spacing_m,
            'model': self.model.plain(),
        }
        path.write_text(json.dumps(plain, indent=2) + '\n')

    @staticmethod
    def load(path: Path, ensemble: str | None = None) -> 'Calibration':
        """Read what `save` wrote.

        Args:
            path: of the file.
            ensemble: hash of the weights in use; None does not compare.

        Raises:
            MapError: the file is none, or belongs to other weights.
        """
        try:
            plain = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise MapError(f'{path}: no readable calibration ({error}); calibrate anew') from None
        if not isinstance(plain, dict) or plain.get('format') != FORMAT:
            raise MapError(f'{path}: expected a file of the format {FORMAT}; this is another file')
        if plain.get('version') != VERSION:
            raise MapError(f'{path}: expected version {VERSION}, got {plain.get("version")}')
        if ensemble is not None and plain.get('ensemble') != ensemble:
            raise MapError(
                f'{path}: calibrates other weights ({str(plain.get("ensemble"))[:12]}, loaded are '
                f'{ensemble[:12]}): calibrate this ensemble, or name its own file'
            )
        try:
            drift, spacing = plain['drift'], plain.get('spacing_m')
            return Calibration(
                str(plain['ensemble']),
                str(plain['metric']),
                MatchModel.from_plain(plain['model']),
                Acceptance.from_plain(plain['acceptance']),
                None if drift is None else DriftReference.from_plain(drift),
                from_mapping(AmbiguityConfig, plain.get('ambiguity', {})),
                None if spacing is None else float(spacing),
            )
        except KeyError as error:
            raise MapError(f'{path}: {error.args[0]} is missing; calibrate anew') from None
        except (MapError, ConfigError) as error:
            raise MapError(f'{path}: {error}; calibrate anew') from None


class Trust:
    """Judge matches by a calibration, and watch whether it still speaks of what comes in.

    The guarantee is withdrawn while the map is larger than the calibration's (more places, more
    that look alike) and while the inputs are not like its inputs (`DriftAlarm`).
    """

    def __init__(self, calibration: Calibration, drift: DriftConfig | None = None) -> None:
        self.calibration = calibration
        self._ambiguity = calibration.ambiguity
        reference = calibration.drift
        self._alarm = None if reference is None else DriftAlarm(reference, drift)

    @property
    def metric(self) -> str:
        """How places are to be ranked."""
        return self.calibration.metric

    @property
    def matches(self) -> int:
        """Neighbours that a judgement needs."""
        return self._ambiguity.matches

    @property
    def spacing_m(self) -> float | None:
        """How far apart places were when this was calibrated; None when nobody knows."""
        return self.calibration.spacing_m

    def reset(self) -> None:
        """Forget the inputs so far: another drive begins."""
        if self._alarm is not None:
            self._alarm.reset()

    def judge(
        self,
        neighbours: Neighbours,
        positions: se3.Array,
        uncertainty: float,
        database_size: int,
    ) -> Judgement:
        """Judge the best match of the next scan of the drive.

        Args:
            neighbours: best first, `matches` of them if the map has so many.
            positions: [K x 3] of these places in the map, metres.
            uncertainty: normalised u_EV of the scan.
            database_size: places that were searched.
        """
        withdrawn = self._withdrawn(uncertainty, database_size)
        if not len(neighbours):
            return Judgement(None, False, withdrawn)
        features = match_features(
            neighbours, positions, uncertainty, self.calibration.metric, self._ambiguity
        )
        model = self.calibration.model
        accepted = withdrawn is None and bool(
            self.calibration.acceptance.accepts(model.belief(features))
        )
        return Judgement(float(model.false_match_probability(features)), accepted, withdrawn)

    def _withdrawn(self, uncertainty: float, database_size: int) -> str | None:
        acceptance = self.calibration.acceptance
        alarm = self._alarm is not None and self._alarm.update(uncertainty).alarm
        if not acceptance.covers(database_size):
            return (
                f'the map has {database_size} places, the calibration had '
                f'{acceptance.database_size} (at most {GROWTH:g} times as many are covered)'
            )
        if alarm:
            return (
                'scans are more uncertain than those of the calibration: not the same kind of place'
            )
        return None


def match_features(
    neighbours: Neighbours,
    positions: se3.Array,
    uncertainty: float,
    metric: str,
    ambiguity: AmbiguityConfig,
) -> MatchFeatures:
    """Return what speaks against the first neighbour; `positions` [K x 2 or 3] in metres."""
    apart = np.asarray(neighbours.distance, np.float64)
    if metric == 'cosine':
        apart = 1.0 - np.asarray(neighbours.similarity, np.float64)
    where = np.asarray(positions, np.float64)[:, :2]
    return MatchFeatures(
        distance=float(apart[0]),
        uncertainty=uncertainty,
        ambiguity=float(match_spread(apart, where, ambiguity)),
        ratio=float(second_place_ratio(apart, where, ambiguity)),
    )
