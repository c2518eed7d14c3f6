"""How the sections of benchmarks.place_recognition are put together, on runs that are made up."""

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks import place_methods, place_recognition, place_sets, place_speed, report
from lcd_common.errors import DataError
from uncertain_place_recognition.embedded_run import EmbeddedRun
from uncertain_place_recognition.evaluation import scores

sys.path.append(str(Path(__file__).parents[1] / 'uncertain_place_recognition'))
from made_runs import made_run


@pytest.fixture
def made(monkeypatch):
    """Let every set be six short runs, those of a foreign sensor being noisier."""

    def embedded(name, chosen, architecture, work, roles=place_sets.ROLES):
        noise = {'sensor': 0.9, 'aliased': 0.6}.get(name, 0.3)
        number = 9 if name == 'calibration' else 3
        return [made_run(f'{name}_{k}', world=name, submaps=40, noise=noise) for k in range(number)]

    monkeypatch.setattr(place_methods, 'embedded', embedded)
    monkeypatch.setattr(scores, 'DRAWS', 10)
    drawn = []  # tests of the command look at the pictures
    monkeypatch.setattr(place_methods, 'write_pictures', lambda study, to: drawn.append(to.name))
    place_methods._calibration.cache_clear()
    yield drawn
    place_methods._calibration.cache_clear()


def test_required_figures_are_found_where_sections_put_them(made, tmp_path):
    figures = {}
    for name in ('interchange', 'recall', 'failure', 'guarantee'):
        _, section = place_recognition.sections(quick=True)[name]
        figures = dict(place_recognition._placed(figures, name, section(tmp_path)))
    absent = report.missing(figures, place_recognition.REQUIRED)
    others = {'embed_ms', 'five_members_ms', 'gate.*'}
    others |= {f'query_ms.{size}' for size in place_speed.SIZES}
    assert set(absent) == others
    assert figures['interchange']['triplet']['minkloc3d']['off_diagonal_r1'] < 0.3
    assert figures['guarantee']['no_match'] > 100
    assert figures['guarantee']['elsewhere']['sensor']['runs_with_alarm'] == 3
    assert figures['guarantee']['target_05']['observed'] < 0.15
    assert len(made) == 8 and made[-1] == 'aliased_open_set'


def test_students_of_shorter_trainings_are_judged_by_their_batches(made, tmp_path, monkeypatch):
    monkeypatch.setenv('PLACE_WEIGHTS', str(tmp_path))
    with pytest.raises(DataError, match='a folder for each number of batches'):
        place_methods.epochs(tmp_path, quick=True)
    for name in ('800', '1600', 'notes'):
        (tmp_path / 'minkloc3d' / 'epochs' / name).mkdir(parents=True)
    found = place_methods.epochs(tmp_path, quick=True)['epochs']['minkloc3d']
    assert list(found) == ['800', '1600']
    known = place_methods.exchanged(tmp_path, quick=True)['interchange']['distilled']['minkloc3d']
    assert found['800']['student_r1'] == known['diagonal_r1']
    assert found['800']['off_diagonal_r1'] == known['off_diagonal_r1']
    assert 0.0 <= found['800']['u_auroc'] <= 1.0


def test_test_sets_are_large_enough_and_of_towns_nobody_trained_on():
    for chosen in place_sets.SETS.values():
        assert chosen.length_m >= 5000.0 and chosen.runs >= 3
        assert all(seed >= 200 for seed in chosen.seeds)
    calibration = place_sets.CALIBRATION
    runs = len(calibration.seeds) * calibration.runs
    assert runs >= 20
    queries = runs * (calibration.length_m / place_sets.SPACING_M - 2)  # ends are rounded off
    assert queries * place_methods._NO_MATCH_SHARE >= 3000
    seeds = [seed for chosen in place_sets.SETS.values() for seed in chosen.seeds]
    assert not set(seeds) & set(calibration.seeds)


def test_embeddings_made_elsewhere_are_taken(tmp_path, monkeypatch):
    monkeypatch.delenv('PLACE_WEIGHTS', raising=False)
    chosen = place_sets.TestSet((200,), 2, 100.0)
    for run in range(2):
        made_run(f'r{run}').save(
            tmp_path / 'embedded' / 'minkloc3d' / 'town_100m' / f'town_200_hdl64_run{run}.npz'
        )
    found = place_sets.embedded('town', chosen, 'minkloc3d', tmp_path)
    assert [run.name for run in found] == ['r0', 'r1']
    assert isinstance(found[0], EmbeddedRun)


def test_embeddings_that_lack_a_role_are_made_again(tmp_path, monkeypatch):
    chosen = place_sets.TestSet((200,), 1, 100.0)
    kept = tmp_path / 'embedded' / 'minkloc3d' / 'town_100m' / 'town_200_hdl64_run0.npz'
    made_run('r0').save(kept)
    has = set(EmbeddedRun.load(kept).members)
    asked = []

    def weights(architecture):
        return {role: tmp_path / role for role in (*has, *extra)}

    def load_ensembles(named, device):
        asked.extend(named)
        raise DataError('so far')

    monkeypatch.setenv('PLACE_WEIGHTS', str(tmp_path))
    monkeypatch.setattr(place_sets, 'weights', weights)
    monkeypatch.setattr(place_sets, 'load_ensembles', load_ensembles)
    extra = ()
    assert [run.name for run in place_sets.embedded('town', chosen, 'minkloc3d', tmp_path)] == [
        'r0'
    ]
    extra = ('new',)
    with pytest.raises(DataError, match='so far'):
        place_sets.embedded('town', chosen, 'minkloc3d', tmp_path, (*place_sets.ROLES, 'new'))
    assert any(one.startswith('new=') for one in asked)


def test_missing_weights_are_named(monkeypatch, tmp_path):
    monkeypatch.delenv('PLACE_WEIGHTS', raising=False)
    with pytest.raises(DataError, match='set PLACE_WEIGHTS'):
        place_sets.weights('minkloc3d')
    monkeypatch.setenv('PLACE_WEIGHTS', str(tmp_path))
    with pytest.raises(DataError, match='expected weights teacher'):
        place_sets.weights('minkloc3d')
    (tmp_path / 'minkloc3d' / 'students').mkdir(parents=True)
    assert list(place_sets.weights('minkloc3d')) == ['students']


def test_searches_are_timed_in_every_index():
    found = place_speed.search_ms(600)
    assert {'exact', 'compact', 'mason'} <= set(found)
    assert all(np.isfinite(value) and value >= 0.0 for value in found.values())


def test_every_section_is_listed(capsys):
    assert place_recognition.main(['--list']) == 0
    shown = capsys.readouterr().out
    for name in ('interchange', 'recall', 'failure', 'guarantee', 'cost', 'real', 'gate'):
        assert name in shown
