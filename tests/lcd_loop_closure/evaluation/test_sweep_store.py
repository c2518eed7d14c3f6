import numpy as np
import pytest
from evaluation_samples import World, out_and_back

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.evaluation.sweep_store import (
    VOXEL_M,
    StoredSweeps,
    SweepWriter,
    is_stored,
)


@pytest.fixture
def stored(tmp_path):
    world = World(out_and_back(30.0))
    with SweepWriter(tmp_path / 'store', 'drive', {'from': 'test'}) as writer:
        for k, T in enumerate(world.T_world_base):
            writer.add(10**18 + k, world.cloud(k), T)
    return world, StoredSweeps(tmp_path / 'store')


def test_sweeps_come_back_within_a_few_millimetres(stored):
    world, sweeps = stored
    assert len(sweeps) == len(world.T_world_base)
    assert sweeps.name == 'drive' and sweeps.facts['from'] == 'test'
    assert np.array_equal(sweeps.T_world_base, world.T_world_base)
    assert list(sweeps.stamps_ns[:2]) == [10**18, 10**18 + 1]
    for k in (0, 7, len(sweeps) - 1):
        whole, kept = world.cloud(k), sweeps.cloud(k)
        cells = {tuple(cell) for cell in np.floor(whole.xyz.astype(float) / VOXEL_M).astype(int)}
        assert len(kept) == len(cells)
        # Every point kept is one that was measured, rounded.
        from scipy.spatial import cKDTree

        away, at = cKDTree(whole.xyz).query(kept.xyz)
        assert away.max() < 0.003
        assert np.abs(kept.intensity - whole.intensity[at]).max() < 1e-3


def test_chosen_sweeps_and_other_poses(stored):
    _, sweeps = stored
    some = sweeps.select(np.array([3, 5, 9])).select(np.array([0, 2]))
    assert np.array_equal(some.cloud(1).xyz, sweeps.cloud(9).xyz)
    assert np.array_equal(some.T_world_base, sweeps.T_world_base[[3, 9]])
    other = some.with_poses(np.tile(np.eye(4), (2, 1, 1)))
    assert np.array_equal(other.T_world_base[1], np.eye(4))
    assert np.array_equal(other.cloud(0).xyz, sweeps.cloud(3).xyz)


def test_no_intensity_empty_and_broken_points(tmp_path):
    xyz = np.array([[1, 2, 3], [np.nan, 0, 0]], np.float32)
    with SweepWriter(tmp_path, 'few') as writer:
        writer.add(1, PointCloud(xyz), np.eye(4))
        writer.add(2, PointCloud(np.empty((0, 3), np.float32), np.empty(0, np.float32)), np.eye(4))
    sweeps = StoredSweeps(tmp_path)
    assert len(sweeps.cloud(0)) == 1 and sweeps.cloud(0).intensity is None
    assert len(sweeps.cloud(1)) == 0 and sweeps.cloud(1).intensity is not None


def test_what_was_not_finished_does_not_count(tmp_path):
    def interrupted() -> None:
        with SweepWriter(tmp_path, 'half') as writer:
            writer.add(1, PointCloud(np.ones((4, 3), np.float32)), np.eye(4))
            raise RuntimeError('power cut')

    with pytest.raises(RuntimeError):
        interrupted()
    assert not is_stored(tmp_path)
    with pytest.raises(DataError, match='no complete set of sweeps'):
        StoredSweeps(tmp_path)


def test_a_file_that_was_cut_short(tmp_path):
    with SweepWriter(tmp_path, 'cut') as writer:
        writer.add(1, World(out_and_back(6.0)).cloud(0), np.eye(4))
    steps = tmp_path / 'steps.int16'
    steps.write_bytes(steps.read_bytes()[:100])
    with pytest.raises(DataError, match='cut short'):
        StoredSweeps(tmp_path)
