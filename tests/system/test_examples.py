"""Run the examples as a user does."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.ros
EXAMPLES = Path(__file__).resolve().parents[2] / 'examples'


def _run(*words: str) -> 'subprocess.CompletedProcess[str]':
    return subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, timeout=120, check=False
    )


def test_examples_are_short() -> None:
    longer = {'map_then_localize.py': 150}  # three parts of the suite, twice through a drive
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
