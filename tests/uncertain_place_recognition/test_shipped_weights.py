"""What ships opens as it is, is what its card says, and its calibration is its own."""

import hashlib
import json

import numpy as np

from lcd_common.cloud import PointCloud
from uncertain_place_recognition.opened import CALIBRATION, SHIPPED, open_recognizer
from uncertain_place_recognition.submap import SubmapMaker


def test_the_card_is_that_of_the_file_and_says_where_it_comes_from():
    file = SHIPPED / 'ensemble.safetensors'
    card = json.loads((SHIPPED / 'ensemble.json').read_text())
    assert hashlib.sha256(file.read_bytes()).hexdigest() == card['sha256']
    assert file.stat().st_size < 16e6
    assert card['trained_on'].startswith('simulation only')
    between = card['validation']['between_students_recall_1']
    assert between['diagonal'] - between['off_diagonal'] < 0.05


def test_places_are_told_apart_and_answers_have_a_probability():
    recognizer = open_recognizer(device='cpu')  # refuses a calibration of other weights
    maker = SubmapMaker(recognizer.ensemble.submap)
    assert (SHIPPED / CALIBRATION).is_file()
    rng = np.random.default_rng(0)
    places = [rng.uniform([-45, -45, 0.5], [45, 45, 6], (6000, 3)) for _ in range(3)]
    for number, xyz in enumerate(places):
        # Each place has its own walls.
        xyz[:3000, number % 2] = np.sign(xyz[:3000, number % 2]) * (8.0 + 9.0 * number)
    clouds = [PointCloud(xyz.astype(np.float32)) for xyz in places]
    members = [recognizer.ensemble.embed(maker.make(cloud)) for cloud in clouds]
    assert all(one.shape == members[0].shape and len(one) == 5 for one in members)
    turned = PointCloud((places[1] @ np.diag([-1.0, -1.0, 1.0])).astype(np.float32))
    again = recognizer.ensemble.embed(maker.make(turned)).mean(0)
    distance = [float(np.linalg.norm(again - one.mean(0))) for one in members]
    assert int(np.argmin(distance)) == 1
