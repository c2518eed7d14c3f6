import hashlib
import json

import pytest

from cmrnet_ekf.networks.config import COMPACT
from cmrnet_ekf.predictors import SHIPPED, Predictor

FOLDER = SHIPPED[0].parent
FILES = sorted(FOLDER.rglob('*.safetensors'))


def role(path):
    return str(path.relative_to(FOLDER).with_suffix(''))


@pytest.mark.parametrize('path', FILES, ids=role)
def test_each_network_has_its_card_and_is_what_its_name_says(path):
    card = json.loads(path.with_suffix('.json').read_text())
    assert card['sha256'] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert card['role'] == role(path) and 'simulation only' in card['trained_on']
    assert card['validation']['errors']['t_median_m'] < card['validation']['rough']['t_median_m']
    assert card['command'] and card['seed'] >= 0
    predictor = Predictor.load(path)
    assert predictor.kind == ('plain' if path.stem.startswith('cmrnet') else path.stem)
    assert predictor.settings.images == COMPACT.images


def test_they_are_small_and_the_default_is_there():
    assert set(SHIPPED) <= set(FILES)
    assert sum(path.stat().st_size for path in FILES) < 20e6
    assert all(path.stat().st_size < 16e6 for path in FILES)


def test_the_default_refines_in_stages_of_ever_smaller_range():
    stages = [Predictor.load(path) for path in SHIPPED]
    assert all(stage.kind == 'der' for stage in stages)
    ranges = [(of.translation_m, of.rotation_rad) for of in (s.trained_for for s in stages)]
    assert ranges == sorted(ranges, reverse=True) and len(set(ranges)) == len(ranges)


def test_the_ensemble_ships_with_all_its_members():
    ensemble = Predictor.load(FOLDER / 'de')
    assert ensemble.kind == 'de' and len(ensemble.networks) == 5
