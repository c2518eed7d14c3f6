"""Open the recognizer that a node's parameters describe."""

from rclpy.node import Node

from lcd_common.device import choose_device
from lcd_common.nodes.parameters import declare_config
from lcd_loop_closure.reduction import ReductionConfig
from uncertain_place_recognition.opened import open_recognizer
from uncertain_place_recognition.place_recognizer import PlaceRecognizer, PlaceRecognizerConfig
from uncertain_place_recognition.retrieval.engines import IndexConfig, IndexMaker
from uncertain_place_recognition.retrieval.faiss_index import FaissConfig
from uncertain_place_recognition.retrieval.qdrant_index import QdrantConfig

_NEAR = (0.6, 1.7)  # times the calibration's spacing


def declared_recognizer(
    node: Node,
    weights: str,
    calibration: str,
    reduction: ReductionConfig,
    device: str,
    distance_m: float,
) -> PlaceRecognizer:
    """Declare the groups recognizer and index, and return a recognizer without places.

    It says where the networks run, and warns when `distance_m` between places is not about the
    calibration's.

    Raises:
        LocalizationError: a parameter is wrong, or something cannot be opened (`open_recognizer`).
    """
    settings = declare_config(node, PlaceRecognizerConfig, 'recognizer')
    index = IndexMaker(
        declare_config(node, IndexConfig, 'index'),
        declare_config(node, FaissConfig, 'index.faiss'),
        declare_config(node, QdrantConfig, 'index.qdrant'),
    )
    recognizer = open_recognizer(weights, calibration, settings, reduction, device, index)
    node.get_logger().info(f'the networks run on {choose_device(device)}')
    warn_of_spacing(node, recognizer, distance_m)
    return recognizer


def warn_of_spacing(node: Node, recognizer: PlaceRecognizer, distance_m: float) -> None:
    """Say so when places lie closer or farther apart than those of the calibration."""
    calibrated = recognizer.calibrated_spacing_m
    if calibrated is not None and not _NEAR[0] <= distance_m / calibrated <= _NEAR[1]:
        node.get_logger().warning(
            f'places.distance is {distance_m:g} m, the calibration had a place every '
            f'{calibrated:.1f} m: its probabilities and promises are of such maps'
        )
