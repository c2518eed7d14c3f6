"""Runs from the simulator and from stored sweeps, by the command."""

import numpy as np
import pytest

from lcd_common.cloud import PointCloud
from lcd_common.errors import ConfigError
from lcd_loop_closure.evaluation.sweep_store import SweepWriter
from uncertain_place_recognition.datasets.make_runs import main
from uncertain_place_recognition.datasets.recorded import simulated_drive, world_of
from uncertain_place_recognition.runs import SubmapRun


@pytest.mark.parametrize(
    ('name', 'world'),
    [
        ('town_3_run1', 'town_3'),
        ('town_30_reverse_run0_hdl64_1500', 'town_30'),
        ('town_3_aliased_run0_vlp16', 'town_3_aliased'),
        ('kitti_00', 'kitti_00'),
        ('townhall', 'townhall'),
    ],
)
def test_drives_of_one_town_share_a_world(name, world):
    assert world_of(name) == world


def test_a_simulated_drive_becomes_a_run(tmp_path, capsys):
    assert main([
        'town:200-200:1', '--out', str(tmp_path), '--style', 'aliased', '--lidar', 'vlp16',
        '--length', '60', '--spacing', '20', '--points', '512', '--quiet',
    ]) == 0  # fmt: skip
    assert 'world town_200_aliased' in capsys.readouterr().out
    run = SubmapRun.load(tmp_path / 'town_200_aliased_run1_vlp16.npz')
    assert run.points.shape[1:] == (512, 3) and len(run) >= 3
    assert run.facts['submap']['reach'] == 50.0
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(run.positions, axis=0), axis=1), 20.0, atol=3.0
    )


def test_stored_sweeps_and_mistakes(tmp_path, capsys):
    wall = np.random.default_rng(0).uniform([-20, 4, 0], [20, 5, 6], (3000, 3))
    with SweepWriter(tmp_path / 'drive', 'town_3_run0', {}) as writer:
        for k in range(6):
            T = np.eye(4)
            T[0, 3] = k
            writer.add(1000 + k, PointCloud(wall.astype(np.float32)), T)
    out = ['--out', str(tmp_path / 'runs'), '--quiet']
    assert main([str(tmp_path / 'drive'), *out, '--spacing', '2']) == 0
    run = SubmapRun.load(tmp_path / 'runs' / 'town_3_run0.npz')
    assert (len(run), run.world) == (3, 'town_3')
    assert main([str(tmp_path / 'nothing'), *out]) == 1
    assert main(['town:x', *out]) == 1
    errors = capsys.readouterr().err.splitlines()
    assert errors[0].startswith('error: ') and 'nothing there' in errors[0]
    assert 'town:SEED' in errors[1]
    with pytest.raises(ConfigError, match='no town style'):
        simulated_drive(200, style='marble')


def test_every_setting_of_submaps_can_be_changed(tmp_path, capsys):
    wall = np.random.default_rng(0).uniform([-20, 4, 0], [20, 5, 6], (3000, 3))
    with SweepWriter(tmp_path / 'drive', 'town_3_run0', {}) as writer:
        writer.add(1000, PointCloud(wall.astype(np.float32)), np.eye(4))
    given = [str(tmp_path / 'drive'), '--out', str(tmp_path / 'runs'), '--quiet', '--points', '128']
    assert main([*given, '--submap', 'reach=12', 'near=5', 'ground=0', 'fewest=50']) == 0
    run = SubmapRun.load(tmp_path / 'runs' / 'town_3_run0.npz')
    assert run.facts['submap'] == {
        'points': 128, 'reach': 12.0, 'near': 5.0, 'ground': 0.0, 'top': 30.0, 'fewest': 50,
    }  # fmt: skip
    metres = 12.0 * run.points[0].astype(np.float32)
    assert np.abs(metres[:, :2]).max() <= 12.01
    assert np.hypot(metres[:, 0], metres[:, 1]).min() > 4.9
    assert main([*given, '--submap', 'reech=12']) == 1
    assert 'NAME one of: fewest, ground, near, points, reach, top' in capsys.readouterr().err
    assert main([*given, '--submap', 'reach=1']) == 1
    assert 'reach must be at least 5 m' in capsys.readouterr().err
