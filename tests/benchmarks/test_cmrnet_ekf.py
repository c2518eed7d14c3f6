"""How the sections of benchmarks.cmrnet_ekf are put together, on answers that are made up."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from bags.simulation.car import camera_model
from benchmarks import (
    cmrnet_ekf,
    cmrnet_methods,
    cmrnet_sets,
    cmrnet_speed,
    cmrnet_tracking,
    ekf_consistency,
    report,
)
from benchmarks.camera_errors import camera_errors, in_closed_loop
from cmrnet_ekf.evaluation.study import Study
from cmrnet_ekf.lidar_image.imager import LidarImager
from cmrnet_ekf.lidar_image.settings import LidarImageConfig
from cmrnet_ekf.localization_errors import summary
from cmrnet_ekf.networks.checkpoint import save_network
from cmrnet_ekf.networks.cmrnet import Cmrnet
from lcd_common import se3
from lcd_common.errors import DataError

sys.path.append(str(Path(__file__).parents[1] / 'cmrnet_ekf'))
from evaluation_cases import known_answers, perfect_answers
from small_samples import SMALL, BendWithImu, street_map

METHODS = ('localization', 'calibration', 'rejection')


@pytest.fixture
def made(monkeypatch):
    rough = summary(np.full(400, 1.8), np.full(400, 0.17))
    answers = {
        'cmrnet': perfect_answers(400),
        'mcd': known_answers(400, told=0.5, kind='made'),
        'de': known_answers(400, seed=2, kind='made'),
        'der': known_answers(400, freedom=4.0, seed=3),
    }
    found = Study(('made_up',), rough, answers)
    monkeypatch.setattr(cmrnet_methods, 'judged', lambda work, quick: found)
    return found


def figures_of(sections, work):
    figures = {}
    for name in sections:
        section = cmrnet_ekf.sections(quick=True)[name][1]
        figures = dict(cmrnet_ekf.place(figures, name, section(work)))
    return figures


def test_required_figures_are_found_where_sections_put_them(made, tmp_path):
    figures = figures_of(METHODS, tmp_path)
    absent = report.missing(figures, cmrnet_ekf.REQUIRED)
    assert not [key for key in absent if key.split('.')[0] in METHODS]
    assert figures['localization']['rough']['t_median_m'] == pytest.approx(1.8)
    assert figures['localization']['cmrnet']['t_mean_m'] < 1e-9
    assert figures['calibration']['mcd']['x'] == pytest.approx(0.209, abs=0.03)
    assert figures['calibration']['der']['x'] < 0.06
    assert 0.15 <= figures['rejection']['de']['discarded_share'] < 0.28
    holds = figures['localization']['relations']
    assert holds['most_accurate'] == 'cmrnet' and not holds['de_is_most_accurate']
    assert holds['rejection_lowers_t_mean'] == {'de': True, 'der': True}
    assert (tmp_path / 'pictures' / 'cmrnet' / 'calibration.png').is_file()
    assert 'made_up' in (tmp_path / 'pictures' / 'cmrnet' / 'results.md').read_text()


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """Untrained networks in all the forms that a role may have."""
    folder = tmp_path / 'weights'
    torch.manual_seed(0)
    save_network(folder / 'cmrnet.safetensors', Cmrnet(SMALL), {})
    save_network(folder / 'mcd' / 'best.safetensors', Cmrnet(replace(SMALL, dropout=0.3)), {})
    save_network(folder / 'mcd' / 'checkpoint.safetensors', Cmrnet(SMALL), {})
    for seed in range(2):
        save_network(folder / 'de' / f'seed{seed}' / 'best.safetensors', Cmrnet(SMALL), {})
    evidential = Cmrnet(replace(SMALL, head='evidential'))
    save_network(folder / 'der' / 'best.safetensors', evidential, {})
    save_network(folder / 'second' / 'der.safetensors', evidential, {})
    monkeypatch.setenv('CMRNET_WEIGHTS', str(folder))
    return folder


def test_weights_are_found_by_role(weights):
    found = cmrnet_sets.predictors()
    assert {role: one.kind for role, one in found.items()} == {
        'cmrnet': 'plain', 'mcd': 'mcd', 'de': 'de', 'der': 'der',
    }  # fmt: skip
    assert list(cmrnet_sets.predictors('second')) == ['der']
    assert cmrnet_sets.predictors('third') == {}
    save_network(weights / 'der_log.safetensors', Cmrnet(replace(SMALL, head='evidential')), {})
    assert list(cmrnet_sets.predictors()) == ['cmrnet', 'mcd', 'de', 'der', 'der_log']
    assert list(cmrnet_sets.predictors(others=False)) == ['cmrnet', 'mcd', 'de', 'der']
    (weights / 'cmrnet.safetensors').unlink()
    assert list(cmrnet_sets.predictors(others=False)) == ['mcd', 'de', 'der']


def test_a_folder_without_any_role_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv('CMRNET_WEIGHTS', str(tmp_path))
    with pytest.raises(DataError, match='expected cmrnet, mcd, de, der in it, or some of them'):
        cmrnet_sets.predictors()


def test_relations_are_told_of_the_networks_that_are_there():
    errors = {'rough': 1.9, 'cmrnet': 0.5, 'der': 0.6}
    found = cmrnet_methods.relations(
        {
            'localization': {role: {'t_mean_m': mean} for role, mean in errors.items()},
            'rejection': {'der': {'t_mean_m': 0.55}},
            'calibration': {'der': {'x': 0.04, 'y': 0.06, 'yaw': 0.05}},
        }
    )
    assert found == {
        'most_accurate': 'cmrnet',
        'missing': ['de', 'mcd'],
        'der_to_cmrnet_t_mean': pytest.approx(1.2),
        'rejection_lowers_t_mean': {'der': True},
        'der_calibrated_within_0_05': {'x': True, 'y': False, 'yaw': True},
    }


def test_without_weights_a_section_says_so(monkeypatch, tmp_path):
    monkeypatch.delenv('CMRNET_WEIGHTS', raising=False)
    for name in (*METHODS, 'ekf'):
        with pytest.raises(DataError, match='set CMRNET_WEIGHTS'):
            cmrnet_ekf.sections(quick=True)[name][1](tmp_path)


def test_the_closed_loop_has_its_required_figures(weights, monkeypatch, tmp_path):
    street = BendWithImu()
    street_map(tmp_path / 'map')

    def town_map(work, town, length_m):
        from cmrnet_ekf.mapping.local_map import LocalMap

        return LocalMap(tmp_path / 'map')

    monkeypatch.setattr(cmrnet_sets, 'town_map', town_map)
    monkeypatch.setattr(cmrnet_sets, 'seen_town', lambda town, length_m, imu: street)
    figures = figures_of(['ekf'], tmp_path)
    absent = report.missing(figures, cmrnet_ekf.REQUIRED)
    assert not [key for key in absent if key.startswith('ekf.')]
    assert figures['ekf']['conditions']['images'] == 10
    assert list(figures['ekf']['thesis']) == ['mcd', 'de', 'der']
    assert list(figures['ekf']['refined']) == ['der']
    towns = figures['ekf']['towns']
    assert towns['der']['runs'] == towns[street.name]['runs'] == 1
    files = {path.name for path in tmp_path.glob(f'*{ekf_consistency.TRACKS}')}
    assert files == {'refined_tracks.npz', f'{street.name}_refined_tracks.npz'}
    assert cmrnet_tracking.RUNS_DER >= 20 and cmrnet_sets.TRACKED_M >= 1000.0
    assert (tmp_path / 'pictures' / 'cmrnet' / 'heat.png').is_file()


def test_towns_are_of_the_test_split():
    towns = (*cmrnet_sets.TOWNS, cmrnet_sets.TRACKED_TOWN)
    assert all(200 <= town < 210 for town in towns) and len(set(towns)) == len(towns)


def test_the_street_that_is_timed_has_the_size_and_fill_that_are_told():
    points = cmrnet_speed.street()
    assert points.shape == (700_000, 3) and points.dtype == np.float32
    imager = LidarImager(camera_model(), LidarImageConfig(radius=0))
    image = imager.image(points, se3.inverse(cmrnet_speed.T_BASE_CAMERA))
    assert float((image > 0).float().mean()) == pytest.approx(0.25, abs=0.005)


def test_errors_of_the_closed_loop_become_those_of_the_filters_camera(tmp_path):
    rng = np.random.default_rng(0)
    sigmas = np.array([0.2, 0.1, 0.1, 0.01, 0.01, 0.02])
    arrays = {}
    for seed, count in enumerate((300, 180)):
        arrays[f'der_{seed}_xi'] = rng.normal(size=(count, 6)) * sigmas
        arrays[f'der_{seed}_covariance'] = np.tile(np.diag(sigmas**2), (count, 1, 1))
        arrays[f'der_{seed}_nees'] = rng.chisquare(6, count + 3)
        for what in ('xi', 'covariance', 'nees'):
            arrays[f'de_{seed}_{what}'] = np.ones_like(arrays[f'der_{seed}_{what}'])
    np.savez(tmp_path / 'tracks.npz', **arrays)
    camera = camera_errors([tmp_path / 'tracks.npz', tmp_path / 'none.npz'])
    assert camera is not None and camera.xi.shape == (5, 80, 6)
    np.testing.assert_array_equal(camera.xi[1], arrays['der_0_xi'][100:180])
    np.testing.assert_array_equal(camera.xi[4], arrays['der_1_xi'][100:180])
    np.testing.assert_array_equal(camera.nees[3], arrays['der_1_nees'][20:100])
    found = ekf_consistency.consistency(3, 8.0, camera)
    assert found['nis_camera'] == pytest.approx(6.0, abs=1.5)
    closed = in_closed_loop(camera)
    assert closed['stretches'] == 5
    assert closed['nees_of_observations_mean'] == pytest.approx(6.0, abs=0.6)
    assert closed['anees_mean'] == pytest.approx(camera.nees.mean())
    assert abs(closed['autocorrelation_of_observations']['1_s']) < 0.1
    assert camera_errors([tmp_path / 'none.npz']) is None
