"""Clouds need more shared memory than Fast DDS takes by itself; a user's own choice stays."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lcd_common.nodes import large_messages

_VARIABLES = (
    'FASTRTPS_DEFAULT_PROFILES_FILE',
    'FASTDDS_DEFAULT_PROFILES_FILE',
    'FASTDDS_BUILTIN_TRANSPORTS',
    'RMW_IMPLEMENTATION',
)
_CHOOSE = """
import os
from lcd_common.nodes.large_messages import carry_large_messages
print(carry_large_messages(), os.environ.get('FASTRTPS_DEFAULT_PROFILES_FILE', '-'))
"""
_SEGMENT = """
import os, rclpy
from lcd_common.nodes.large_messages import carry_large_messages
if {large}:
    carry_large_messages()
rclpy.init()
node = rclpy.create_node('segment')
sizes = [os.stat(p).st_size for p in os.popen(
    "grep -o '/dev/shm/fastrtps_[0-9a-f]*$' /proc/%d/maps | sort -u" % os.getpid()
).read().split()]
print(max(sizes))
"""


def _run(code: str, folder: Path, **variables: str) -> str:
    environment = {k: v for k, v in os.environ.items() if k not in _VARIABLES}
    run = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True, timeout=60,
        env={**environment, **variables}, cwd=folder,
    )  # fmt: skip
    return run.stdout.strip()


_NEEDS_MEMORY = pytest.mark.skipif(
    not Path('/dev/shm').is_dir()
    or shutil.disk_usage('/dev/shm').free < large_messages._ENOUGH_BYTES,
    reason='needs 256 MB of shared memory',
)


@_NEEDS_MEMORY
def test_the_profile_is_chosen_where_the_user_chose_nothing(tmp_path: Path) -> None:
    chosen, path = _run(_CHOOSE, tmp_path).split()
    assert chosen == 'True' and path.endswith('fast_dds.xml') and Path(path).is_file()
    assert _run(_CHOOSE, tmp_path, RMW_IMPLEMENTATION='rmw_fastrtps_cpp').startswith('True')


@pytest.mark.parametrize(
    'variables',
    [
        {'FASTRTPS_DEFAULT_PROFILES_FILE': '/my/profile.xml'},
        {'FASTDDS_DEFAULT_PROFILES_FILE': '/my/profile.xml'},
        {'FASTDDS_BUILTIN_TRANSPORTS': 'UDPv4'},
        {'RMW_IMPLEMENTATION': 'rmw_cyclonedds_cpp'},
    ],
)
def test_a_choice_of_the_user_stays(tmp_path: Path, variables: dict[str, str]) -> None:
    kept = variables.get('FASTRTPS_DEFAULT_PROFILES_FILE', '-')
    assert _run(_CHOOSE, tmp_path, **variables) == f'False {kept}'


def test_a_profile_in_the_folder_stays(tmp_path: Path) -> None:
    (tmp_path / 'DEFAULT_FASTRTPS_PROFILES.xml').write_text('<dds/>')
    assert _run(_CHOOSE, tmp_path) == 'False -'


def test_little_shared_memory_is_left_to_the_default(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for name in _VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    free = shutil.disk_usage(tmp_path)._replace(free=64 << 20)
    monkeypatch.setattr(shutil, 'disk_usage', lambda _: free)
    assert not large_messages.carry_large_messages()
    monkeypatch.setattr(large_messages, '_SHARED_MEMORY', tmp_path / 'none')
    assert not large_messages.carry_large_messages()
    assert 'FASTRTPS_DEFAULT_PROFILES_FILE' not in os.environ


@_NEEDS_MEMORY
@pytest.mark.ros
def test_the_segment_holds_several_sweeps(tmp_path: Path) -> None:
    sweep = 130_000 * 16
    assert int(_run(_SEGMENT.format(large=False), tmp_path)) < sweep
    assert int(_run(_SEGMENT.format(large=True), tmp_path)) > 10 * sweep
