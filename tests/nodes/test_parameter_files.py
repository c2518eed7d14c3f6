"""The parameter files are those that the settings make, and ROS reads them as the defaults."""

import runpy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip('rclpy')
from cmrnet_ekf.nodes.ekf_node import EkfNode
from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode
from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode

pytestmark = pytest.mark.ros
ROOT = Path(__file__).resolve().parents[2]


def test_they_are_up_to_date() -> None:
    tool = runpy.run_path(str(ROOT / 'tools' / 'parameter_files.py'))
    stale = [path.name for path, text in tool['parameter_files']().items()
             if path.read_text() != text]  # fmt: skip
    assert stale == [], 'run python tools/parameter_files.py'


@pytest.mark.parametrize(
    ('package', 'name', 'cls'),
    [
        ('cmrnet_ekf', 'ekf', EkfNode),
        ('lcd_loop_closure', 'lidar_odometry', LidarOdometryNode),
        ('lcd_loop_closure', 'loop_closure', LoopClosureNode),
        ('lcd_loop_closure', 'pose_graph', PoseGraphNode),
        ('uncertain_place_recognition', 'place_recognition', PlaceRecognitionNode),
    ],
)
def test_ros_reads_every_default_from_them(
    make: Callable[..., Any],
    package: str,
    name: str,
    cls: Any,
    small_weights: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr('uncertain_place_recognition.opened.SHIPPED', small_weights)
    file = ROOT / package / 'config' / f'{name}.yaml'
    plain = make(cls)
    # What stands in the file is read: not one parameter is left to its default in the code.
    given = make(cls, namespace='deep/down', cli_args=['--ros-args', '--params-file', str(file)])
    values = _flat(yaml.safe_load(file.read_text())[f'/**/{name}']['ros__parameters'])
    for key, value in values.items():
        assert given.get_parameter(key).value == plain.get_parameter(key).value == value, key
    assert set(given._parameter_overrides) == set(values)
    own = {'use_sim_time', 'start_type_description_service'}
    assert set(plain._parameters) - own == set(values)


def _flat(tree: dict[str, Any], prefix: str = '') -> dict[str, Any]:
    out: dict[str, Any] = {}
    for key, value in tree.items():
        out |= _flat(value, f'{prefix}{key}.') if isinstance(value, dict) else {prefix + key: value}
    return out
