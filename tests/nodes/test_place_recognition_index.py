"""Choose the engine of place_recognition by parameters, and share a map between two nodes."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip('rclpy')
import made_up_drive as drive
from place_feed import Fed, fed_by

from lcd_common.errors import ConfigError
from lcd_common.nodes import messages
from uncertain_place_recognition.nodes.place_messages import message_id
from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode
from uncertain_place_recognition.retrieval.fleet_place import is_elsewhere

pytestmark = pytest.mark.ros


@pytest.fixture
def fed(make: Callable[..., Any], small_weights: Path) -> Callable[..., Fed]:
    """Make a fed node with small weights."""
    return fed_by(make, small_weights)


@pytest.mark.parametrize('engine', ['exact', 'compact', 'faiss', 'qdrant'])
def test_every_engine_answers_and_keeps_maps(
    fed: Callable[..., Fed], engine: str, tmp_path: Path
) -> None:
    if engine in ('faiss', 'qdrant'):
        pytest.importorskip('faiss' if engine == 'faiss' else 'qdrant_client')
    made = fed(index__engine=engine, index__faiss__exact_below=2)
    for step in range(5):
        made.step(step)
    made.step(60, seen=2)
    assert made.answers[-1].matches[0].place_id == 2
    assert made.save(tmp_path / 'map').success
    assert made.load(tmp_path / 'map').message.startswith('6 places loaded')
    made.step(61, seen=3)
    assert made.answers[-1].matches[0].place_id == 3


def test_a_second_vehicle_answers_with_the_first_one_s_places(
    fed: Callable[..., Fed], tmp_path: Path
) -> None:
    pytest.importorskip('qdrant_client')
    shared = {'index__engine': 'qdrant', 'index__qdrant__folder': str(tmp_path / 'shared')}
    red = fed(index__qdrant__vehicle='red', **shared)
    for step in range(4):
        red.step(step)
    red.node.destroy_node()  # a folder serves one process at a time; a server serves all
    blue = fed(index__qdrant__vehicle='blue', index__qdrant__radius=50.0, **shared)
    blue.step(20)
    blue.step(21, seen=2)
    published = blue.answers[-1].matches[0]
    told = {message_id(id): one for id, one in blue.node.recognizer._elsewhere.items()}
    assert published.place_id >= 2**31
    assert (told[published.place_id].vehicle, told[published.place_id].number) == ('red', 2)
    pose, _ = messages.from_pose_with_covariance(published.pose)
    np.testing.assert_allclose(pose, drive.true_pose(2), atol=1e-6)
    assert blue.counted('places added') == 2


def test_ids_of_32_bits() -> None:
    assert message_id(7) == 7
    assert not is_elsewhere(2**32 - 1)
    assert message_id(2**62 + 5) == 2**31 + 5
    assert message_id(2**63 - 1) == 2**32 - 1


def test_wrong_settings_are_named(make: Callable[..., Any], small_weights: Path) -> None:
    weights = str(small_weights)
    with pytest.raises(ConfigError, match='engine must be one of exact, compact, faiss, qdrant'):
        make(PlaceRecognitionNode, index__engine='annoy', weights=weights)
    pytest.importorskip('qdrant_client')
    away = {'index__engine': 'qdrant', 'index__qdrant__url': 'http://127.0.0.1:9'}
    with pytest.raises(ConfigError, match='expected the name of this vehicle'):
        make(PlaceRecognitionNode, weights=weights, **away)


def test_an_operator_sees_what_the_last_answer_was_based_on(fed: Callable[..., Fed]) -> None:
    made = fed()

    def shown() -> dict[str, str]:
        return {v.key: v.value for v in made.node.diagnostics.status().values}

    normalised = 'uncertainty of the last answer, normalised'
    assert shown()[normalised] == shown()['places searched for the last answer'] == 'no answer yet'
    locate, answers = made.node.recognizer.locate, []
    made.node.recognizer.locate = lambda *a: answers.append(locate(*a)) or answers[-1]
    for step in range(3):
        made.step(step)
    assert float(shown()[normalised]) == pytest.approx(answers[-1].uncertainty_normalised, abs=1e-5)
    assert (shown()['places'], shown()['places searched for the last answer']) == ('3', '2')
