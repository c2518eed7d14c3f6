"""Training where little is installed: torch, numpy, scipy, safetensors and this suite."""

import json
import subprocess
import sys

import pytest
from small_runs import small_run

from uncertain_place_recognition.training.train import main

# Nothing is found of all that is installed but these, and what torch itself requires.
_BARE = """
import importlib.metadata, sys

MAY = {
    'torch', 'torchgen', 'functorch', 'numpy', 'scipy', 'safetensors', 'lcd_common',
    'lcd_loop_closure', 'uncertain_place_recognition', 'typing_extensions', 'sympy', 'mpmath',
    'networkx', 'jinja2', 'markupsafe', 'fsspec', 'filelock', 'packaging', 'nvidia', 'triton',
}
NOT = {'rclpy', 'open3d', 'gtsam', 'lcd_msgs', 'bags', 'tqdm', 'matplotlib', 'numba', 'yaml'}
NOT |= set(importlib.metadata.packages_distributions()) - MAY


class Without:
    def __init__(self, finder):
        self.finder = finder

    def __getattr__(self, name):
        return getattr(self.finder, name)

    def find_spec(self, name, *rest):
        return None if name.partition('.')[0] in NOT else self.finder.find_spec(name, *rest)


there = {name.partition('.')[0] for name in sys.modules}
sys.meta_path[:] = [Without(finder) for finder in sys.meta_path]
from uncertain_place_recognition.training.train import main

status = main(sys.argv[1:])
got = NOT & {name.partition('.')[0] for name in sys.modules} - there
assert not got, got
raise SystemExit(status)
"""
_SMALL = [
    '--network', 'bev_netvlad', '--set', 'rows=8', 'columns=16', 'widths=6,8', 'blocks=1,1',
    'clusters=4', 'size=8', '--train', 'steps=4', 'clouds=12', '--pairs', 'positive=11',
    'negative=35', '--validate-every', '2', '--members', '1',
]  # fmt: skip


@pytest.fixture(scope='module')
def command(tmp_path_factory):
    folder = tmp_path_factory.mktemp('runs')
    for name in 'ab':
        small_run(name, 'w', spacing_m=10.0).save(folder / 'train' / f'{name}.npz')
        small_run(name, 'u', spacing_m=10.0).save(folder / 'validation' / f'{name}.npz')
    return ['ensemble', '--runs', str(folder / 'train'), '--validation',
            str(folder / 'validation'), *_SMALL]  # fmt: skip


@pytest.fixture(scope='module')
def trained(command, tmp_path_factory):
    out = tmp_path_factory.mktemp('trained')
    found = subprocess.run(
        [sys.executable, '-c', _BARE, *command, '--out', str(out)], capture_output=True, text=True
    )
    assert found.returncode == 0, found.stderr
    return out, found


def test_an_ensemble_is_trained_without_bars_and_curves(trained):
    out, found = trained
    assert (out / 'ensemble.safetensors').is_file()
    assert (out / 'teacher' / 'best.safetensors').is_file()
    assert 'step 4 of 4' in found.stdout
    assert not list(out.rglob('curves.png'))
    # Of four judgements, two of each network.
    assert found.stderr.count('matplotlib is not installed') == 1


def test_curves_are_drawn_later_where_they_can_be(trained, command, capsys):
    out, _ = trained
    assert main([*command, '--out', str(out), '--quiet']) == 0
    assert capsys.readouterr().out.count('trained already') == 2
    for name in ('teacher', 'student_1'):
        assert (out / name / 'curves.png').stat().st_size > 1000


def test_the_radius_of_right_matches_is_a_flag(command, tmp_path, capsys):
    shared = [*command, '--quiet', '--minutes', '0.5']
    assert main([*shared, '--out', str(tmp_path / 'near'), '--validation-radius', '12']) == 0
    card = json.loads((tmp_path / 'near' / 'teacher' / 'best.json').read_text())
    assert card['validation_radius_m'] == 12.0
    # Runs lie one upon the other, so a radius of nothing at all has right matches, too.
    assert main([*shared, '--out', str(tmp_path / 'far'), '--validation-radius', '-1']) == 1
    assert 'true match within -1 m' in capsys.readouterr().err


def test_the_benchmark_may_be_parted_into_regions(command, tmp_path, capsys):
    def part(name, region):
        run = small_run(name, 'oxford', spacing_m=10.0)
        facts = {'normalisation': 'benchmark', **({'region': region} if region else {})}
        run.facts.update(facts)
        run.save(tmp_path / f'{name}.npz')
        return str(tmp_path / f'{name}.npz')

    out, inside = part('out', 'outside oxford'), [part('in1', 'inside oxford')]
    inside.append(part('in2', 'inside oxford'))
    small = [*_SMALL[:-2], '--quiet', '--out', str(tmp_path / 'o')]
    assert main(['teacher', '--runs', out, '--validation', *inside, *small]) == 0
    for wrong in (['--runs', *inside, '--validation', out],
                  ['--runs', out, '--validation', part('whole', '')],
                  ['--runs', out, '--validation', part('rest', 'inside university')]):  # fmt: skip
        assert main(['teacher', *wrong, *small]) == 1
        assert 'keep towns apart' in capsys.readouterr().err
