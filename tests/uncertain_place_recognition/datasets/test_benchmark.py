"""Runs of the PointNetVLAD benchmark, as its authors lay them out."""

import numpy as np
import pytest

from lcd_common.errors import DataError
from uncertain_place_recognition.datasets.benchmark import (
    read_benchmark_run,
    read_benchmark_submap,
)


@pytest.fixture
def run_folder(tmp_path):
    folder = tmp_path / 'oxford' / '2014-05-19-13-20-57'
    rng = np.random.default_rng(0)
    rows = ['timestamp,northing,easting']
    for name in ('pointcloud_20m', 'pointcloud_20m_10overlap'):
        (folder / name).mkdir(parents=True)
    for k in range(3):
        stamp = 1400505794141322 + k
        for name in ('pointcloud_20m', 'pointcloud_20m_10overlap'):
            rng.uniform(-1, 1, (4096, 3)).tofile(folder / name / f'{stamp}.bin')
        rows.append(f'{stamp},{5735000.5 + k},{620000.25 - k}')
    (folder / 'pointcloud_locations_20m.csv').write_text('\n'.join(rows) + '\n')
    (folder / 'pointcloud_locations_20m_10overlap.csv').write_text('\n'.join(rows[:2]) + '\n')
    return folder


def test_a_run_is_read_with_easting_as_x(run_folder):
    run = read_benchmark_run(run_folder, 'pointcloud_20m')
    assert run.name == 'oxford_2014-05-19-13-20-57' and run.world == 'oxford'
    assert run.points.shape == (3, 4096, 3)
    np.testing.assert_array_equal(run.positions[1], [619999.25, 5735001.5])
    assert run.stamps_ns[0] == 1400505794141322000
    raw = np.fromfile(run_folder / 'pointcloud_20m' / '1400505794141322.bin').reshape(-1, 3)
    np.testing.assert_allclose(run.points[0], raw, atol=1e-3)
    assert len(read_benchmark_run(run_folder, 'pointcloud_20m_10overlap')) == 1


def test_the_set_must_be_named_where_there_are_several(run_folder):
    with pytest.raises(DataError, match='choose with submaps'):
        read_benchmark_run(run_folder)


def test_float32_and_other_files_are_refused(tmp_path):
    path = tmp_path / 'a.bin'
    rng = np.random.default_rng(0)
    rng.uniform(-1, 1, (4096, 3)).astype(np.float32).tofile(path)
    with pytest.raises(DataError, match='float32'):
        read_benchmark_submap(path)
    rng.uniform(-1, 1, (8192, 3)).astype(np.float32).tofile(path)  # as long as it should be
    with pytest.raises(DataError, match='float32, or not normalised'):
        read_benchmark_submap(path)
    rng.uniform(-30, 30, (4096, 3)).tofile(path)
    with pytest.raises(DataError, match='not normalised'):
        read_benchmark_submap(path)


def test_tables_without_the_columns_are_refused(run_folder):
    table = run_folder / 'pointcloud_locations_20m.csv'
    table.write_text('time,x,y\n1,2,3\n')
    with pytest.raises(DataError, match='timestamp, northing, easting'):
        read_benchmark_run(run_folder, 'pointcloud_20m')
    table.unlink()
    (run_folder / 'pointcloud_locations_other.csv').write_text('')
    with pytest.raises(DataError, match=r'expected pointcloud_locations_20m\.csv'):
        read_benchmark_run(run_folder, 'pointcloud_20m')
