"""What is saved comes back; what is damaged is refused; no kill and no mistake loses a map."""

import json
import os
import random
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from saved_maps import made_up_map, same_map

from lcd_common.errors import DataError, MapError
from lcd_common.trajectory import read_poses
from lcd_loop_closure.g2o import read_g2o
from lcd_loop_closure.map_store import SavedMap, load_map, save_map


@pytest.mark.parametrize('count', [0, 1, 7, 1203])
def test_everything_comes_back(tmp_path: Path, count: int) -> None:
    saved = made_up_map(count, points=5)
    folder = save_map(saved, tmp_path / 'map')
    assert same_map(load_map(folder), saved)
    assert len(list((folder / 'clouds').iterdir())) == -(-count // 500)


def test_the_same_map_makes_the_same_bytes(tmp_path: Path) -> None:
    for name in ('a', 'b'):
        save_map(made_up_map(), tmp_path / name)
    files = sorted(p.relative_to(tmp_path / 'a') for p in (tmp_path / 'a').rglob('*.*'))
    assert len(files) >= 7
    for file in files:
        assert (tmp_path / 'a' / file).read_bytes() == (tmp_path / 'b' / file).read_bytes()


def test_nothing_in_it_needs_pickle(tmp_path: Path) -> None:
    folder = save_map(made_up_map(), tmp_path / 'map')
    for path in folder.rglob('*.npz'):
        with np.load(path, allow_pickle=False) as file:
            assert all(file[name].dtype.kind != 'O' for name in file.files)


def test_other_tools_read_the_exports(tmp_path: Path) -> None:
    saved = made_up_map()
    folder = save_map(saved, tmp_path / 'map')
    tum = file_interface.read_tum_trajectory_file(str(folder / 'trajectory.tum'))
    np.testing.assert_allclose(tum.poses_se3, saved.graph.T_map_base, atol=1e-8)
    np.testing.assert_allclose(tum.timestamps, saved.graph.stamps_ns * 1e-9, atol=1e-9)
    kitti = read_poses(folder / 'poses_kitti.txt')
    np.testing.assert_allclose(kitti, saved.graph.T_map_base, atol=1e-8)
    graph = read_g2o(folder / 'graph.g2o')
    links = [(k, k + 1) for k in range(6)]
    assert [tuple(edge) for edge in graph.edges.tolist()] == [*links, (0, 5)]  # not the unused loop
    np.testing.assert_allclose(graph.covariances[-1], saved.graph.loops[0].covariance, rtol=1e-6)


def test_sessions_whose_clocks_overlap_still_export_a_trajectory(tmp_path: Path) -> None:
    saved = made_up_map(4)
    graph = replace(saved.graph, stamps_ns=np.array([100, 200, 150, 200]))
    folder = save_map(replace(saved, graph=graph), tmp_path / 'map')
    tum = file_interface.read_tum_trajectory_file(str(folder / 'trajectory.tum'))
    np.testing.assert_allclose(tum.positions_xyz, graph.T_map_base[[0, 2, 1], :3, 3], atol=1e-8)


def test_a_map_is_replaced_as_a_whole(tmp_path: Path) -> None:
    big, small = made_up_map(1203, points=5), made_up_map(3, seed=5)
    save_map(big, tmp_path / 'map')
    save_map(small, tmp_path / 'map')
    assert same_map(load_map(tmp_path / 'map'), small)
    assert [p.name for p in tmp_path.iterdir()] == ['map']
    assert [p.name for p in (tmp_path / 'map' / 'clouds').iterdir()] == ['000000.npz']


def test_a_kill_at_any_step_leaves_the_old_map_or_the_new_one(tmp_path: Path) -> None:
    script = Path(__file__).with_name('killed_saves.py')
    run = subprocess.run(
        [sys.executable, str(script), str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr
    rows = [line.split() for line in run.stdout.splitlines()]
    # 9 files and 3 folders flushed, two renames, and the old files removed one by one.
    assert len(rows) > 20
    assert rows[-1][2] == 'finished'
    verdicts = [row[1] for row in rows]
    assert set(verdicts) == {'old', 'new'}
    assert verdicts == sorted(verdicts, reverse=True)  # old ones first: there is one moment
    assert all(len(row) == 3 for row in rows)  # nothing is left beside the map


def test_kills_at_random_times_lose_nothing(tmp_path: Path) -> None:
    old, new = made_up_map(40, seed=1, points=4000), made_up_map(40, seed=2, points=4000)
    target = tmp_path / 'map'
    save_map(old, target)
    code = (
        'import sys; sys.path.insert(0, sys.argv[1])\n'
        'from saved_maps import made_up_map\n'
        'from lcd_loop_closure.map_store import save_map\n'
        'maps = [made_up_map(40, seed=s, points=4000) for s in (2, 1)]\n'
        'print("ready", flush=True)\n'
        'while True:\n'
        '    for saved in maps: save_map(saved, sys.argv[2])\n'
    )
    dice = random.Random(0)
    for _ in range(4):
        child = subprocess.Popen(
            [sys.executable, '-c', code, str(Path(__file__).parent), str(target)],
            stdout=subprocess.PIPE,
        )
        assert child.stdout is not None
        child.stdout.readline()
        try:
            child.wait(timeout=dice.uniform(0.0, 0.3))
        except subprocess.TimeoutExpired:
            os.kill(child.pid, signal.SIGKILL)
        child.wait()
        child.stdout.close()
        loaded = load_map(target)
        assert same_map(loaded, old) or same_map(loaded, new)


def test_a_full_disk_leaves_the_old_map(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old = made_up_map(seed=1)
    save_map(old, tmp_path / 'map')

    def full(*args: object, **kwargs: object) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(np, 'savez', full)
    with pytest.raises(MapError, match='No space left'):
        save_map(made_up_map(seed=2), tmp_path / 'map')
    assert same_map(load_map(tmp_path / 'map'), old)
    assert [p.name for p in tmp_path.iterdir()] == ['map']


def test_what_is_no_map_is_never_touched(tmp_path: Path) -> None:
    home = tmp_path / 'home'
    (home / 'photos').mkdir(parents=True)
    (home / 'photos' / 'a.jpg').write_text('precious')
    with pytest.raises(MapError, match=r'home: holds photos, which is no part of a map'):
        save_map(made_up_map(), home)
    assert (home / 'photos' / 'a.jpg').read_text() == 'precious'
    (tmp_path / 'file').write_text('precious')
    with pytest.raises(MapError, match='is not a folder'):
        save_map(made_up_map(), tmp_path / 'file')
    assert (tmp_path / 'file').read_text() == 'precious'
    with pytest.raises(MapError, match='empty path'):
        save_map(made_up_map(), '')
    folder = save_map(made_up_map(), tmp_path / 'map')
    (folder / 'notes.txt').write_text('precious')
    with pytest.raises(MapError, match=r'notes\.txt'):
        save_map(made_up_map(), folder)
    assert (folder / 'notes.txt').read_text() == 'precious'
    link = tmp_path / 'link'
    link.symlink_to(home)
    with pytest.raises(MapError, match='is not a folder'):
        save_map(made_up_map(), link)


def test_an_empty_folder_may_become_a_map(tmp_path: Path) -> None:
    (tmp_path / 'map').mkdir()
    save_map(made_up_map(), tmp_path / 'map')
    assert len(load_map(tmp_path / 'map').graph) == 7


def test_two_saves_at_once_are_told_apart(tmp_path: Path) -> None:
    import fcntl

    (tmp_path / '.map.saving').mkdir()
    other = os.open(tmp_path / '.map.saving', os.O_RDONLY)
    fcntl.flock(other, fcntl.LOCK_EX)
    try:
        with pytest.raises(MapError, match='another process is saving'):
            save_map(made_up_map(), tmp_path / 'map')
    finally:
        os.close(other)
    save_map(made_up_map(), tmp_path / 'map')


def test_loading_what_is_not_there_or_no_map(tmp_path: Path) -> None:
    with pytest.raises(MapError, match='found none; check the path'):
        load_map(tmp_path / 'nowhere')
    with pytest.raises(MapError, match=r'it has no meta\.json'):
        load_map(tmp_path)
    with pytest.raises(MapError, match='empty path'):
        load_map('')


def _changed_meta(folder: Path, **changes: object) -> None:
    path = folder / 'meta.json'
    path.write_text(json.dumps({**json.loads(path.read_text()), **changes}))


def test_another_version_and_a_damaged_meta_are_refused(tmp_path: Path) -> None:
    folder = save_map(made_up_map(), tmp_path / 'map')
    _changed_meta(folder, version=2)
    with pytest.raises(MapError, match='a map of version 2, expected 1'):
        load_map(folder)
    _changed_meta(folder, version=1, files={})
    with pytest.raises(MapError, match='lists no files'):
        load_map(folder)
    _changed_meta(folder, format='other')
    with pytest.raises(MapError, match='expected the format'):
        load_map(folder)
    (folder / 'meta.json').write_text('{')
    with pytest.raises(MapError, match='not readable'):
        load_map(folder)


@pytest.mark.parametrize('name', ['graph.npz', 'descriptors.npz', 'clouds/000000.npz'])
def test_a_missing_cut_or_flipped_file_is_named(tmp_path: Path, name: str) -> None:
    folder = save_map(made_up_map(), tmp_path / 'map')
    path, data = folder / name, (folder / name).read_bytes()
    path.write_bytes(data[: len(data) // 2])
    with pytest.raises(MapError, match=rf'{name}: expected {len(data)} bytes'):
        load_map(folder)
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 1
    path.write_bytes(flipped)
    with pytest.raises(MapError, match=f'{name}: its checksum is wrong'):
        load_map(folder)
    path.unlink()
    with pytest.raises(MapError, match=f'{name}: missing'):
        load_map(folder)


def _saved_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, **changes: np.ndarray) -> Path:
    """Save a map whose graph file says something else, with a true checksum."""
    from lcd_loop_closure import map_store

    right = map_store.arrays_of
    monkeypatch.setattr(map_store, 'arrays_of', lambda graph: {**right(graph), **changes})
    return save_map(made_up_map(), tmp_path / 'map')


@pytest.mark.parametrize(
    ('changes', 'complaint'),
    [
        ({'stamps_ns': np.arange(3)}, 'stamps_ns: expected 7 integers'),
        ({'ids': np.array([0, 1, 2, 2, 4, 5, 6])}, 'ids that increase'),
        ({'T_map_base': np.full((7, 4, 4), np.nan)}, 'T_map_base: a number is not finite'),
        ({'motions': np.ones((7, 4, 4))}, 'motions: a matrix is no rigid transform'),
        ({'motion_covariances': np.zeros((7, 5, 5))}, 'motion_covariances: expected real'),
        ({'loop_match_id': np.array([0, 99])}, 'keyframes that are not there'),
        ({'loop_state': np.array([77, 0])}, '77 is not a valid LoopState'),
        ({'gnss_keyframe_id': np.array([50])}, 'satellite fix is tied to a keyframe'),
    ],
)
def test_a_graph_that_cannot_be_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, changes: dict[str, np.ndarray], complaint: str
) -> None:
    folder = _saved_with(tmp_path, monkeypatch, **changes)
    with pytest.raises(MapError, match=complaint):
        load_map(folder)


def test_a_map_needs_as_many_clouds_as_keyframes() -> None:
    saved = made_up_map()
    with pytest.raises(DataError, match='7 keyframes, 6 clouds and 7 descriptors'):
        SavedMap(saved.graph, saved.clouds[1:], saved.descriptors)
