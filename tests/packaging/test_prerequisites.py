"""Check that a missing prerequisite ends in one line that names its Debian package."""

import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

# A Python that claims a version and lacks what FAILS matches in the code it is given.
FAKE_PYTHON = """#!/bin/bash
case "$*" in
  *version_info*) echo {version} ;;
  {fails}) exit 1 ;;
esac
"""


@pytest.fixture
def call(root: Path, tmp_path: Path) -> Callable[..., subprocess.CompletedProcess]:
    """Call a function of tools/prerequisites.sh with nothing but the given commands on PATH."""
    fakes = tmp_path / 'bin'
    fakes.mkdir()

    def run(function: str, **commands: str) -> subprocess.CompletedProcess:
        for name, text in commands.items():
            path = fakes / name.replace('_', '.')
            path.write_text(text)
            path.chmod(0o755)
        script = (
            f'fail() {{ echo "error: $*" >&2; exit 1; }}; source tools/prerequisites.sh; {function}'
        )
        return subprocess.run(
            [shutil.which('bash') or 'bash', '-euo', 'pipefail', '-c', script],
            cwd=root,
            env={'PATH': str(fakes)},
            capture_output=True,
            text=True,
            check=False,
        )

    return run


OK = '#!/bin/bash\n'


def fake_python(version: str = '3.11', fails: str = 'nothing') -> str:
    return FAKE_PYTHON.format(version=version, fails=fails)


def test_a_complete_machine_passes(call):
    done = call('check_prerequisites python', python=fake_python(), cmake=OK, **{'c++': OK})
    assert (done.returncode, done.stderr) == (0, '')


def test_a_missing_library_names_its_package(call):
    python = fake_python(fails='*libusb*')
    done = call('check_prerequisites python', python=python, cmake=OK, **{'c++': OK})
    assert done.returncode == 1
    assert done.stderr == 'error: missing libusb-1.0.so.0: sudo apt install libusb-1.0-0\n'


def test_everything_missing_is_still_one_line(call):
    done = call('check_prerequisites python', python=fake_python('3.12', fails='*import*'))
    assert done.returncode == 1
    assert done.stderr.count('\n') == 1
    packages = 'g++ cmake python3.12-venv python3.12-dev libusb-1.0-0 libgl1 libgomp1'
    assert done.stderr.endswith(f': sudo apt install {packages}\n')


def test_the_first_python_that_runs_and_fits_is_taken(call):
    broken = '#!/bin/bash\nexit 127\n'
    done = call('find_python 0', python3_12=broken, python3_11=fake_python(), python3=OK)
    assert done.stdout.strip().endswith('/python3.11')


def test_no_fitting_python_is_one_line_with_what_was_tried(call):
    done = call('find_python 0', python3=fake_python('3.10'))
    assert done.returncode == 1
    assert done.stderr.count('\n') == 1
    assert 'Python 3.11 or 3.12 is needed' in done.stderr
    assert 'python3: 3.10' in done.stderr
    assert 'python3.12: does not run' in done.stderr


def test_make_help_names_every_target(root):
    done = subprocess.run(['make'], cwd=root, capture_output=True, text=True, check=True)
    for target in ('setup', 'demo', 'test', 'lint', 'colcon', 'clean', 'TORCH_INDEX'):
        assert f'  {target} ' in done.stdout
