"""The Foxglove and RViz layouts parse, and show what the suite publishes."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from bags.topics import CAMERA_INFO_TOPIC, TF_STATIC_TOPIC, TOPICS

VIZ = Path(__file__).resolve().parents[2] / 'viz'
SHOWN = ('lcd_common', 'lcd_loop_closure', 'uncertain_place_recognition')
PACKAGES = [VIZ.parent / name for name in SHOWN]
RECORDED = {topic for topic, _ in TOPICS.values()} | {CAMERA_INFO_TOPIC, TF_STATIC_TOPIC}


@pytest.fixture(scope='module')
def foxglove() -> dict[str, Any]:
    layout: dict[str, Any] = json.loads((VIZ / 'suite.foxglove.json').read_text())
    return layout


@pytest.fixture(scope='module')
def rviz() -> dict[str, Any]:
    layout: dict[str, Any] = yaml.safe_load((VIZ / 'suite.rviz').read_text())
    return layout


def foxglove_topics(layout: dict[str, Any]) -> dict[str, str]:
    """Return each topic and the panel that shows it."""
    found = {}
    for panel, settings in layout['configById'].items():
        topics = [*settings.get('topics', {})]
        topics += [path['value'] for path in settings.get('paths', [])]
        topics += [settings[key] for key in ('topicPath', 'topicToRender') if key in settings]
        topics += settings.get('imageMode', {}).values()
        found |= {re.split(r'[.\[{]', topic)[0]: panel for topic in topics}
    return found


def rviz_displays(layout: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for display in layout['Visualization Manager']['Displays']:
        if 'Topic' in display:
            yield display


def test_foxglove_layout_names_every_panel_once(foxglove: dict[str, Any]) -> None:
    def panels(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            assert node['direction'] in ('row', 'column') and 0 < node['splitPercentage'] < 100
            yield from panels(node['first'])
            yield from panels(node['second'])

    placed = list(panels(foxglove['layout']))
    assert sorted(placed) == sorted(foxglove['configById'])
    assert all(re.fullmatch(r'\w+!\w+', panel) for panel in placed)


def test_rviz_layout_is_seen_from_the_map(rviz: dict[str, Any]) -> None:
    manager = rviz['Visualization Manager']
    assert manager['Global Options']['Fixed Frame'] == 'map'
    names = [display['Name'] for display in manager['Displays']]
    assert len(names) == len(set(names))
    assert all(
        display['Class'].startswith('rviz_default_plugins/') for display in manager['Displays']
    )


def test_plotted_stages_are_timed_by_the_nodes(foxglove: dict[str, Any]) -> None:
    source = ''.join(
        path.read_text() for package in PACKAGES for path in sorted(package.rglob('*.py'))
    )
    keys = [
        key
        for settings in foxglove['configById'].values()
        for path in settings.get('paths', [])
        for key in re.findall(r'key=="(.+?)"', path['value'])
    ]
    assert keys
    for key in keys:
        stage = re.sub(r' (median|p99) \[ms\]$', '', key)
        assert re.search(rf"(stage|timer|_timer|timed|time)\('{stage}'", source), key


@pytest.mark.ros
def test_every_topic_is_published(
    ros: None, foxglove: dict[str, Any], rviz: dict[str, Any], small_weights: Path
) -> None:
    from rclpy.qos import DurabilityPolicy

    from lcd_common.nodes.parameters import overrides
    from lcd_loop_closure.nodes.lidar_odometry_node import LidarOdometryNode
    from lcd_loop_closure.nodes.loop_closure_node import LoopClosureNode
    from lcd_loop_closure.nodes.pose_graph_node import PoseGraphNode
    from uncertain_place_recognition.nodes.place_recognition_node import PlaceRecognitionNode

    own = overrides(weights=str(small_weights))
    nodes = [LidarOdometryNode(), LoopClosureNode(), PoseGraphNode()]
    nodes.append(PlaceRecognitionNode(parameter_overrides=own))
    try:
        durability = {p.topic_name: p.qos_profile.durability for n in nodes for p in n.publishers}
    finally:
        for node in nodes:
            node.destroy_node()
    known = set(durability) | RECORDED
    shown = {display['Topic']['Value']: display for display in rviz_displays(rviz)}
    assert set(foxglove_topics(foxglove)) <= known
    assert set(shown) <= known
    for topic, display in shown.items():
        latched = durability.get(topic) == DurabilityPolicy.TRANSIENT_LOCAL
        assert (display['Topic']['Durability Policy'] == 'Transient Local') == latched, topic
