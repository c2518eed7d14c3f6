"""Open an ensemble with all that belongs to it, ready to recognise places."""

from pathlib import Path

from lcd_common.device import choose_device
from lcd_common.errors import ConfigError
from lcd_loop_closure.reduction import ReductionConfig
from uncertain_place_recognition.ensemble import EmbeddingEnsemble
from uncertain_place_recognition.place_recognizer import PlaceRecognizer, PlaceRecognizerConfig
from uncertain_place_recognition.retrieval.engines import IndexMaker
from uncertain_place_recognition.submap import SubmapMaker
from uncertain_place_recognition.trust import Calibration, Trust
from uncertain_place_recognition.weights_hash import weights_hash

SHIPPED = Path(__file__).parent / 'weights'
CALIBRATION = 'calibration.json'


def open_recognizer(
    weights: str = '',
    calibration: str = '',
    settings: PlaceRecognizerConfig | None = None,
    reduction: ReductionConfig | None = None,
    device: str = 'auto',
    index: IndexMaker | None = None,
) -> PlaceRecognizer:
    """Return a recognizer without places.

    Args:
        weights: file or folder of an ensemble; empty: the one that ships.
        calibration: its file; empty: calibration.json beside the weights, where there is one.
            Without one nothing is accepted.
        settings: of answers and growth.
        reduction: of the clouds that are kept.
        device: auto (a GPU where there is one), cpu, cuda or cuda:N.
        index: makes what searches the places; None: all are compared.

    Raises:
        ConfigError: there are no weights, no such device, or no such index with this calibration.
        MissingPackageError: the index needs a package that is not installed.
        DataError: the weights cannot be read.
        MapError: the calibration cannot be read, or belongs to other weights; or a shared map does
            not answer.
    """
    path = Path(weights).expanduser() if weights else SHIPPED
    if not path.exists():
        said = f'{path} does not exist' if weights else 'no weights ship with this version'
        raise ConfigError(f'{said}: train an ensemble, and name its file or folder in weights')
    ensemble = EmbeddingEnsemble.load(path, choose_device(device))
    fingerprint = weights_hash(ensemble.members)
    beside = (path if path.is_dir() else path.parent) / CALIBRATION
    file = Path(calibration).expanduser() if calibration else beside
    trust = None
    if calibration or file.is_file():
        trust = Trust(Calibration.load(file, fingerprint))
    return PlaceRecognizer(
        ensemble,
        SubmapMaker(ensemble.submap),
        trust,
        settings,
        reduction,
        index,
        fingerprint=fingerprint,
    )
