"""Run the examples as a user does."""

import importlib.util
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.itinerary import JourneyConfig

pytestmark = pytest.mark.ros
EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'


def _run(*words: str) -> 'subprocess.CompletedProcess[str]':
    return subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, timeout=120, check=False
    )


def test_examples_are_short() -> None:
    longer = {'map_then_localize.py': 160}  # three parts of the suite, twice through a drive
    for path in EXAMPLES.glob('*.py'):
        assert len(path.read_text().splitlines()) <= longer.get(path.name, 60), path.name


def test_a_replay_prints_its_result_and_saves_the_map(tmp_path: Path) -> None:
    script, folder = str(EXAMPLES / 'replay_in_lockstep.py'), tmp_path / 'map'
    run = _run(script, 'street', '--duration', '1', '--save-map', str(folder))
    assert run.returncode == 0, run.stderr
    words = run.stdout.split()
    assert words[1] == 'keyframes,' and int(words[0]) > 2
    assert f'map saved in {folder}' in run.stdout
    assert (folder / 'meta.json').is_file()


def test_mistakes_are_one_line(tmp_path: Path) -> None:
    run = _run(str(EXAMPLES / 'replay_in_lockstep.py'), str(tmp_path / 'nothing'))
    assert run.returncode == 1
    assert run.stderr.startswith('error: ') and run.stderr.count('\n') == 1
    run = _run(str(EXAMPLES / 'slam_in_one_process.py'), '--map', str(tmp_path / 'nothing'))
    assert run.returncode == 1
    assert 'found none; check the path' in run.stderr
    run = _run(str(EXAMPLES / 'map_then_localize.py'), 'street', '--out', str(tmp_path / 'mapped'))
    assert run.returncode == 1
    assert run.stderr.startswith('error: street: has no camera') and run.stderr.count('\n') == 1
    script = str(EXAMPLES / 'slam_with_place_recognition.py')
    run = _run(script, '--weights', str(tmp_path / 'nothing'))
    assert run.returncode == 1
    assert 'nothing does not exist: train an ensemble' in run.stderr
    assert 'Traceback' not in run.stderr


@pytest.fixture
def example(ros: None, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Import map_then_localize, with 50 m of a town for a recording: images cost time."""
    path = EXAMPLES / 'map_then_localize.py'
    spec = importlib.util.spec_from_file_location('map_then_localize', path)
    assert spec is not None and spec.loader is not None
    module: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sensors = SensorsConfig(lidar='vlp16', camera=True, gnss=False)
    drive = SimulatedDrive(100, 0, JourneyConfig(length=50.0), sensors)
    monkeypatch.setattr(module, 'open_input', lambda source: drive)
    # The session's context serves.
    monkeypatch.setattr(module.rclpy, 'init', lambda **options: None)
    monkeypatch.setattr(module.rclpy, 'try_shutdown', lambda: None)
    return module


def test_a_mapped_drive_is_found_and_tracked_and_its_map_used_again(
    example: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: Any
) -> None:
    localized = []
    localize = example.localize

    def remembered(*given: Any) -> Any:
        localized.append((given, localize(*given)))
        return localized[-1][1]

    monkeypatch.setattr(example, 'localize', remembered)
    out = tmp_path / 'mapped'
    assert example.main(['drive', '--out', str(out), '--start', '9']) == 0
    said, logged = capfd.readouterr()
    assert 'found by place recognition at' in said
    assert 'on /tf' not in logged, 'base_link has one parent'
    result = re.search(r'(\d+) poses by camera and IMU; .* median ([\d.]+) m', said)
    assert result is not None and int(result[1]) > 50
    assert float(result[2]) < 10.0, 'how near is a matter of the network'
    assert {p.name for p in out.iterdir()} == {'tiles', 'places', 'poses.tum'}

    assert example.main(['drive', '--out', str(out)]) == 1
    assert f'--map {out} uses its map' in capfd.readouterr().err
    (_, found), made = localized[0], (out / 'poses.tum').stat().st_mtime_ns
    monkeypatch.setattr(example, 'localize', lambda *given: (localized.append(given), found)[1])
    assert example.main(['drive', '--map', str(out), '--start', '9']) == 0
    _, folder, *rest = localized[1]
    assert folder == out and rest == [9.0, '']
    again = capfd.readouterr().out
    assert again.splitlines()[-1] == said.splitlines()[-1]
    assert (out / 'poses.tum').stat().st_mtime_ns == made
    assert example.main(['drive', '--map', str(tmp_path / 'none')]) == 1
    assert 'poses.tum: No such file' in capfd.readouterr().err


def test_the_composed_nodes_come_up_and_end_with_ctrl_c(ros: None) -> None:
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray

    node = rclpy.create_node('watcher')
    environment = {**os.environ, 'PYTHONUNBUFFERED': '1'}
    script = str(EXAMPLES / 'slam_in_one_process.py')
    process = subprocess.Popen(
        [sys.executable, script, '--points', '/velodyne', '--ros-args', '-r', '__ns:=/car'],
        env=environment, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        expected = {f'/car/{name}' for name in ('lidar_odometry', 'loop_closure', 'pose_graph')}
        deadline = time.monotonic() + 60.0
        found: set[str] = set()
        while not expected <= found and time.monotonic() < deadline:
            names = node.get_node_names_and_namespaces()
            found = {f'{space.rstrip("/")}/{name}' for name, space in names}
            time.sleep(0.05)
        assert expected <= found
        while node.count_subscribers('/velodyne') < 2 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert node.count_subscribers('/velodyne') == 2
        # Diagnostics come from timers: all nodes are made, and the executor spins.
        heard: list[DiagnosticArray] = []
        node.create_subscription(DiagnosticArray, '/diagnostics', heard.append, 10)
        while not heard and time.monotonic() < deadline:
            rclpy.spin_once(node, timeout_sec=0.1)
        assert heard
    finally:
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=30)
        node.destroy_node()
    assert process.returncode == 0
    assert 'Traceback' not in errors
