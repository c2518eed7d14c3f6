"""Runs: what is saved comes back, what does not fit is refused."""

import numpy as np
import pytest
from small_runs import small_run

from lcd_common.cloud import PointCloud
from lcd_common.errors import DataError
from lcd_loop_closure.evaluation.sweep_store import StoredSweeps, SweepWriter
from uncertain_place_recognition.runs import SubmapRun, load_runs, run_of_sweeps
from uncertain_place_recognition.submap import SubmapConfig, SubmapMaker


def test_a_saved_run_comes_back_and_loads_by_folder(tmp_path):
    run = small_run('town_0_run0', 'town_0')
    run.save(tmp_path / 'b.npz')
    small_run('other').save(tmp_path / 'a.npz')
    first, again = load_runs([tmp_path])
    assert (first.name, again.name, again.world) == ('other', 'town_0_run0', 'town_0')
    for name in ('stamps_ns', 'T_world_base', 'points'):
        np.testing.assert_array_equal(getattr(again, name), getattr(run, name))
    assert again.points.dtype == np.float16
    assert again.length_m == pytest.approx(44.0)
    assert len(again.select(slice(0, 3))) == 3


def test_what_is_no_run_is_refused(tmp_path):
    run = small_run()
    with pytest.raises(DataError, match='expected 12 poses'):
        SubmapRun('a', 'w', run.stamps_ns, run.T_world_base[:5], run.points)
    with pytest.raises(DataError, match='submaps P x 3'):
        SubmapRun('a', 'w', run.stamps_ns, run.T_world_base, run.points[:, :, :2])
    with pytest.raises(DataError, match='no runs'):
        load_runs([tmp_path])
    (tmp_path / 'bad.npz').write_bytes(b'nothing')
    with pytest.raises(DataError, match='holds no run'):
        load_runs([tmp_path])
    np.savez(tmp_path / 'bad.npz', points=np.array([{}], dtype=object))  # pickled: never read
    with pytest.raises(DataError, match='holds no run'):
        load_runs([tmp_path])


def test_stored_sweeps_become_a_run_and_a_covered_sensor_is_left_out(tmp_path):
    rng = np.random.default_rng(0)
    wall = rng.uniform([-20, 4, 0], [20, 5, 6], (3000, 3)).astype(np.float32)
    with SweepWriter(tmp_path / 'drive', 'town_3_same_way', {}) as writer:
        for k in range(3):
            T = np.eye(4)
            T[0, 3] = k
            seen = wall if k != 1 else wall[:20]
            writer.add(1000 + k, PointCloud(seen), T)
    maker = SubmapMaker(SubmapConfig(points=256))
    run = run_of_sweeps(StoredSweeps(tmp_path / 'drive'), maker.make, 'town_3')
    assert run.stamps_ns.tolist() == [1000, 1002]
    assert run.points.shape == (2, 256, 3)
    assert run.world == 'town_3' and run.facts['dropped'] == 1
    with pytest.raises(DataError, match='no cloud has enough points'):
        run_of_sweeps(StoredSweeps(tmp_path / 'drive').select(np.array([1])), maker.make)
