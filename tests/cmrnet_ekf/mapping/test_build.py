"""Run build_lidar_map as a user does, in the small analytic town."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from bags.inputs import open_input
from bags.numbered_files import read_labels
from bags.records import LidarScan
from cmrnet_ekf.mapping import build
from cmrnet_ekf.mapping.tile_folder import TileFolder
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_loop_closure.graph_settings import GraphSettings
from lcd_loop_closure.keyframes import Keyframe
from lcd_loop_closure.map_store import save_map
from lcd_loop_closure.online_map import OnlineMap, OnlineMapConfig
from lcd_loop_closure.session_anchor import AnchorConfig

STREET = ['street', '--columns', '120', '--duration', '1', '--quiet']


def points(folder: Path) -> np.ndarray:
    cloud = np.concatenate(list(TileFolder.open(folder).clouds()))
    return cloud[np.lexsort(cloud.T)]


def test_a_drive_becomes_a_map_with_its_own_or_with_other_poses(tmp_path, capsys):
    assert build.main([*STREET, '--out', str(tmp_path / 'truth'), '--keep-moving']) == 0
    assert 'sweeps' in capsys.readouterr().out
    open_input('street').truth().write_tum(tmp_path / 'poses.tum')
    assert build.main([*STREET, '--out', str(tmp_path / 'tum'), '--keep-moving', '--poses',
                       str(tmp_path / 'poses.tum')]) == 0  # fmt: skip
    one, other = points(tmp_path / 'truth'), points(tmp_path / 'tum')
    assert len(one) > 500
    assert len(other) == pytest.approx(len(one), rel=0.01)
    assert np.median(cKDTree(one).query(other)[0]) < 1e-3


def test_sweeps_lie_where_the_poses_put_them(tmp_path):
    from bags.input_arguments import drive_from

    arguments = build._parser().parse_args([*STREET, '--out', 'x'])
    drive = drive_from(arguments)
    first = next(iter(drive.records(kinds=[LidarScan])))
    sweep = next(build.drive_sweeps(drive, drive.truth()))
    T_base_lidar = {m.child: m.T_parent_child for m in drive.mountings}['lidar']
    np.testing.assert_array_equal(sweep.T_base_sensor, T_base_lidar)
    np.testing.assert_array_equal(sweep.cloud.xyz, first.cloud.xyz)
    np.testing.assert_allclose(sweep.T_map_base, drive.truth().at(first.stamp_ns))


def saved(path: Path, clouds: list[np.ndarray]) -> Path:
    """Save a map of the pose graph: clouds [N x 3], map frame, seen every two metres."""
    graph = OnlineMap(OnlineMapConfig(), GraphSettings(), AnchorConfig(), lambda cause: None)
    step = se3.from_rotation_translation(np.eye(3), [2.0, 0, 0])
    for number, world in enumerate(clouds):
        T = np.linalg.matrix_power(step, number)
        cloud = PointCloud(se3.transform_points(se3.inverse(T), world).astype(np.float32))
        motion = np.eye(4) if number == 0 else step
        graph.add_keyframe(
            Keyframe(number, 10**9 * (number + 1), T, motion, 1e-4 * np.eye(6), cloud)
        )
    save_map(graph.saved(), path)
    return path


@pytest.mark.parametrize('how', [['--sensor-height', '1.7'], ['--keep-moving'], ['--every', '2']])
def test_a_map_of_the_pose_graph_becomes_a_lidar_map(tmp_path, how, capsys):
    world = np.random.default_rng(0).uniform([-30, -8, 0], [40, 8, 3], (30000, 3))
    saved(tmp_path / 'saved', [world] * 3)
    command = [str(tmp_path / 'saved'), '--out', str(tmp_path / 'map'), '--voxel', '0.3', '--quiet']
    command += ['--keep-moving', *how] if '--every' in how else how
    assert build.main(command) == 0
    assert f'{2 if "--every" in how else 3} sweeps' in capsys.readouterr().out
    # These points fill the air: the sweeps see through some of what others of them hit.
    distance, _ = cKDTree(world).query(points(tmp_path / 'map'))
    assert np.percentile(distance, 99) < 0.05, 'but for how finely the saved map keeps its points'


def test_keyframes_look_from_where_the_lidar_sat(tmp_path):
    x, y = np.meshgrid(np.arange(-10, 60, 0.2), np.arange(-6, 6, 0.2))
    ground = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    box = np.random.default_rng(0).uniform([13, -0.6, 0.5], [14, 0.6, 1.3], (2000, 3))
    folder = saved(tmp_path / 'saved', [np.concatenate([ground, box]), *[ground] * 5])
    left = {}
    for name, how in {'high': ['--sensor-height', '1.73'], 'ground': ['--sensor-height', '0'],
                      'kept': ['--keep-moving']}.items():  # fmt: skip
        command = [str(folder), '--out', str(tmp_path / name), '--quiet', *how]
        assert build.main(command) == 0
        left[name] = (points(tmp_path / name)[:, 2] > 0.3).sum()
    assert left['kept'] > 300
    assert left['high'] < 0.05 * left['kept'], 'what was there once and is seen over later'
    assert left['ground'] > 0.95 * left['kept'], 'from the ground nobody looks over anything'


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        ([], 'give --sensor-height M'),
        (['--sensor-height', 'nan'], 'must be 0 to 20 metres'),
        (['--sensor-height', '-1'], 'must be 0 to 20 metres'),
        (['--sensor-height', '1.7', '--labels', '--start', '3'], 'leave out --labels, --start'),
        (['--keep-moving', '--poses', 'a.tum', '--duration', '3'], 'leave out --poses, --duration'),
        (['--keep-moving', '--topic', 'points=/a'], 'leave out --topic'),
    ],
)
def test_what_a_saved_map_cannot_heed_is_refused(tmp_path, capsys, arguments, message):
    folder = saved(tmp_path / 'saved', [np.ones((10, 3))])
    assert build.main([str(folder), *arguments, '--out', str(tmp_path / 'map')]) == 1
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1, error
    assert not (tmp_path / 'map').exists()


def test_semantickitti_labels_say_what_moves(tmp_path):
    labels = np.array([40, 252, 10, 259 | (7 << 16)], np.uint32)
    labels.tofile(tmp_path / '000000.label')
    read = read_labels(tmp_path / '000000.label', 4)
    np.testing.assert_array_equal(PointCloud(np.zeros((4, 3), np.float32), label=read).moving,
                                  [False, True, False, True])  # fmt: skip


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (['nothing_there'], 'nothing there'),
        ([*STREET, '--every', '0'], '--every'),
        ([*STREET, '--labels'], 'have no labels'),
        ([*STREET, '--labels', 'no_such_folder'], '000000.label'),
        ([*STREET, '--poses', 'no_such.tum'], 'no_such.tum'),
        ([*STREET, '--voxel', '0'], 'voxel'),
        ([*STREET, '--sensor-height', '1.7'], 'is of a saved map'),
    ],
)
def test_mistakes_are_one_line(tmp_path, capsys, arguments, message):
    assert build.main([*arguments, '--out', str(tmp_path / 'map')]) == 1
    error = capsys.readouterr().err
    assert message in error and error.count('\n') == 1, error
