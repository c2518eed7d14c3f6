import hashlib
import json

import pytest

from cmrnet_ekf.networks.config import COMPACT
from cmrnet_ekf.predictors import SHIPPED, Predictor

FILES = sorted(SHIPPED[0].parent.glob('*.safetensors'))


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.stem)
def test_each_network_has_its_card_and_is_what_its_name_says(path):
    card = json.loads(path.with_suffix('.json').read_text())
    assert card['sha256'] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert card['role'] == path.stem and 'simulation only' in card['trained_on']
    assert card['validation']['errors']['t_median_m'] < card['validation']['rough']['t_median_m']
    predictor = Predictor.load(path)
    assert predictor.kind == {'cmrnet': 'plain'}.get(path.stem, path.stem)
    assert predictor.settings.images == COMPACT.images


def test_they_are_small_and_the_default_is_there():
    assert set(SHIPPED) <= set(FILES)
    assert all(Predictor.load(path).kind == 'der' for path in SHIPPED)
    assert sum(path.stat().st_size for path in FILES) < 20e6
