"""A measurement names the code it measured."""

import subprocess
from pathlib import Path

import pytest

from benchmarks import report


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    (tmp_path / 'benchmarks' / 'results').mkdir(parents=True)
    (tmp_path / 'docs' / 'images').mkdir(parents=True)
    for name in ('source.py', 'benchmarks/results/drive.json', 'docs/images/map.svg'):
        (tmp_path / name).write_text('before')
    _git(tmp_path, 'init', '-q')
    _git(tmp_path, 'add', '-A')
    _git(tmp_path, '-c', 'user.name=a', '-c', 'user.email=a@b.c', 'commit', '-q', '-m', 'first')
    return tmp_path


def _git(tree: Path, *arguments: str) -> str:
    done = subprocess.run(['git', *arguments], cwd=tree, check=True, capture_output=True, text=True)
    return done.stdout.strip()


def test_results_and_pictures_do_not_make_the_tree_dirty(tree: Path) -> None:
    commit = _git(tree, 'rev-parse', 'HEAD')[:12]
    assert report.commit(tree) == commit
    (tree / 'benchmarks' / 'results' / 'drive.json').write_text('after')
    (tree / 'benchmarks' / 'results' / 'town.json').write_text('new')
    (tree / 'docs' / 'images' / 'map.svg').write_text('after')
    assert report.commit(tree) == commit
    assert report.commit(tree / 'docs') == commit  # also seen from below


@pytest.mark.parametrize('name', ['source.py', 'benchmarks/new_section.py'])
def test_code_that_no_commit_has_makes_it_dirty(tree: Path, name: str) -> None:
    (tree / name).write_text('after')
    assert report.commit(tree) == _git(tree, 'rev-parse', 'HEAD')[:12] + '-dirty'


def test_without_a_repository_the_commit_is_unknown(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv('GIT_CEILING_DIRECTORIES', str(tmp_path.parent))
    assert report.commit(tmp_path) == 'unknown'
