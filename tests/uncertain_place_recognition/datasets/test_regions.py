"""The benchmark's test regions: what training leaves out, and where queries come from."""

import json

import numpy as np
import pytest

from lcd_common.errors import ConfigError, DataError
from uncertain_place_recognition import evaluate
from uncertain_place_recognition.datasets.benchmark import read_benchmark_run
from uncertain_place_recognition.datasets.make_runs import main
from uncertain_place_recognition.datasets.regions import CENTRES, SITES, in_test_region
from uncertain_place_recognition.embedded_run import EmbeddedRun
from uncertain_place_recognition.runs import SubmapRun

P1 = CENTRES['oxford'][0]


def test_squares_reach_150_m_from_the_published_centres():
    northing, easting = P1
    assert (northing, easting) == (5735712.768124, 620084.402381)
    assert [len(centres) for centres in CENTRES.values()] == [4, 3, 3]
    around = np.array([[0, 0], [149.9, 149.9], [150.1, 0], [0, -150.1], [-149.9, 0.0]])
    found = in_test_region(np.array([easting, northing]) + around, 'oxford')
    assert found.tolist() == [True, True, False, False, True]


def test_sites_have_their_own_regions_and_the_business_district_is_all_test():
    centres = {name: np.array(found)[:, ::-1] for name, found in CENTRES.items()}
    for name, where in centres.items():
        for other in centres:
            assert in_test_region(where, other).all() == (name == other)
        assert in_test_region(where + 1e4, 'business').all()
    with pytest.raises(ConfigError, match='oxford, university, residential, business'):
        in_test_region(np.zeros((1, 2)), 'kitti')


@pytest.fixture(scope='module')
def benchmark(tmp_path_factory):
    """Two runs of Oxford along a road through the first test region, and one elsewhere."""
    folder = tmp_path_factory.mktemp('benchmark') / 'oxford'
    rng = np.random.default_rng(0)
    for name, shift in (('run_1', 0.0), ('run_2', 4.0), ('inside', 1.0)):
        (folder / name / 'pointcloud_20m').mkdir(parents=True)
        rows = ['timestamp,northing,easting']
        for k in range(10):
            stamp = 1400505794141322 + k
            rng.uniform(-1, 1, (4096, 3)).tofile(folder / name / 'pointcloud_20m' / f'{stamp}.bin')
            # 100 m before the centre, then on beyond the region; the last run stays inside.
            ahead = -100.0 + (5.0 if name == 'inside' else 40.0) * k + shift
            rows.append(f'{stamp},{P1[0] + ahead!r},{P1[1]!r}')
        (folder / name / 'pointcloud_locations_20m.csv').write_text('\n'.join(rows) + '\n')
    return folder


def test_training_runs_leave_test_regions_out(benchmark, tmp_path, capsys):
    sources = [str(benchmark / name) for name in ('run_1', 'inside')]
    given = ['--benchmark', 'pointcloud_20m', '--quiet']
    command = ['--out', str(tmp_path / 'train'), *sources, *given]
    assert main([*command, '--outside', 'university', '--outside', 'oxford']) == 0
    assert f'{sources[1]}: no submap is outside oxford university, left out' in (
        capsys.readouterr().out
    )
    assert [path.name for path in (tmp_path / 'train').iterdir()] == ['oxford_run_1.npz']
    run = SubmapRun.load(tmp_path / 'train' / 'oxford_run_1.npz')
    assert len(run) == 3 and not in_test_region(run.positions, 'oxford').any()
    assert run.facts['region'] == 'outside oxford university'
    assert run.facts['normalisation'] == 'benchmark'
    inside = ['--out', str(tmp_path / 'inside'), *sources, *given, '--inside', 'oxford']
    assert main(inside) == 0
    run = SubmapRun.load(tmp_path / 'inside' / 'oxford_run_1.npz')
    assert len(run) == 7 and in_test_region(run.positions, 'oxford').all()


def test_regions_and_submap_settings_do_not_mix_with_other_sources(benchmark, tmp_path, capsys):
    out = ['--out', str(tmp_path), '--quiet']
    assert main(['town:0', *out, '--outside', 'oxford']) == 1
    assert '--outside wants --benchmark SET' in capsys.readouterr().err
    run = [str(benchmark / 'run_1'), *out, '--benchmark', 'pointcloud_20m']
    assert main([*run, '--submap', 'reach=30']) == 1
    assert "the benchmark's submaps come made: leave out reach=30" in capsys.readouterr().err


def test_the_tables_of_the_other_sites_have_another_name(benchmark, tmp_path):
    folder = tmp_path / 'inhouse_datasets' / 'university_run1'
    for spacing, count in (('10', 3), ('25', 2)):
        (folder / f'pointcloud_25m_{spacing}').mkdir(parents=True)
        rows = ['timestamp,northing,easting']
        for k in range(count):
            source = benchmark / 'run_1' / 'pointcloud_20m' / f'{1400505794141322 + k}.bin'
            (folder / f'pointcloud_25m_{spacing}' / f'{k}.bin').write_bytes(source.read_bytes())
            rows.append(f'{k},363621.0,142864.0')
        table = folder / f'pointcloud_centroids_{spacing}.csv'
        table.write_text('\n'.join(rows) + '\n')
    assert len(read_benchmark_run(folder, 'pointcloud_25m_10')) == 3
    run = read_benchmark_run(folder, 'pointcloud_25m_25')
    assert len(run) == 2 and in_test_region(run.positions, 'university').all()
    (folder / 'pointcloud_centroids_25.csv').unlink()
    (folder / 'pointcloud_locations_20m.csv').write_text('')
    with pytest.raises(DataError, match='centroids'):
        read_benchmark_run(folder, 'pointcloud_25m_25')


def embedded(name, northing, code, world='oxford'):
    positions = np.column_stack([np.full(len(northing), P1[1]), P1[0] + np.asarray(northing)])
    stamps_ns = np.arange(len(northing)) * 1_000_000_000
    return EmbeddedRun(name, world, stamps_ns, positions, {'students': code[:, None]})


def test_queries_come_from_test_regions_and_databases_are_whole(tmp_path, capsys):
    rng = np.random.default_rng(0)
    northing = np.arange(-200.0, 800.0, 50.0)
    code = rng.normal(size=(len(northing), 8)).astype(np.float32)
    mixed = code.copy()
    # Inside, two of six queries look like a place outside, which only a whole database has.
    inside = np.flatnonzero(np.abs(northing + 3.0) < 150.0)
    mixed[inside[:2]] = code[-2:]
    mixed[-5:] = code[:5]  # outside all are wrong, which does not count
    embedded('a', northing, code).save(tmp_path / 'runs' / 'a.npz')
    embedded('b', northing + 3.0, mixed).save(tmp_path / 'runs' / 'b.npz')
    common = ['--queries', str(tmp_path / 'runs' / 'b.npz'), '--quiet', '--database',
              str(tmp_path / 'runs' / 'a.npz'), '--out', str(tmp_path / 'out')]  # fmt: skip
    assert evaluate.main([*common, '--query-region', 'oxford']) == 0
    figures = json.loads((tmp_path / 'out' / 'results.json').read_text())
    assert figures['query_region'] == 'oxford' and figures['pairs'] == 1
    shared = figures['recall']['shared']
    assert shared['queries'] == len(inside) == 6
    assert shared['r1'] == pytest.approx(4 / 6)
    told = {one['name']: (one['searched'], one['queries']) for one in figures['runs']}
    assert told == {'a': (True, 0), 'b': (False, 6)}
    assert evaluate.main([*common, '--query-region', 'university']) == 1
    assert 'lies in a test region of university' in capsys.readouterr().err
    assert set(SITES) == {'oxford', 'university', 'residential', 'business'}
