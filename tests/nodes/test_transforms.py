"""/tf_static gives mountings; /tf tells when two nodes own one edge."""

import numpy as np
import pytest
from geometry_msgs.msg import TransformStamped
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from lcd_common import se3
from lcd_common.nodes import messages, qos
from lcd_common.nodes.transforms import StaticTransforms, TransformAuthority

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures('ros')]
RNG = np.random.default_rng(0)


def edge(parent: str, child: str, T: np.ndarray, stamp: int = 1) -> TransformStamped:
    return TransformStamped(
        header=messages.header(stamp, parent),
        child_frame_id=child,
        transform=messages.transform_message(T),
    )


@pytest.fixture
def node():
    node = Node('transforms')
    yield node
    node.destroy_node()


def test_lookup_follows_the_tree_both_ways(node: Node) -> None:
    static = StaticTransforms(node)
    T_base_mast, T_mast_lidar, T_base_camera = (se3.exp(RNG.normal(size=6)) for _ in range(3))
    static.on_tf_static(TFMessage(transforms=[edge('mast', 'lidar', T_mast_lidar)]))
    static.on_tf_static(
        TFMessage(
            transforms=[
                edge('base_link', 'mast', T_base_mast),
                edge('/base_link', '/camera', T_base_camera),
            ]
        )
    )
    expected = T_base_mast @ T_mast_lidar
    np.testing.assert_allclose(static.lookup('base_link', 'lidar'), expected, atol=1e-12)
    np.testing.assert_allclose(
        static.lookup('camera', 'lidar'), se3.inverse(T_base_camera) @ expected, atol=1e-12
    )
    np.testing.assert_allclose(static.lookup('unknown', 'unknown'), np.eye(4))
    assert static.lookup('base_link', 'radar') is None


def test_broken_and_circular_trees_do_not_hang(node: Node) -> None:
    static = StaticTransforms(node)
    broken = edge('base_link', 'lidar', np.eye(4))
    broken.transform.rotation.w = 0.0
    static.on_tf_static(TFMessage(transforms=[broken]))
    assert static.lookup('base_link', 'lidar') is None
    static.on_tf_static(
        TFMessage(transforms=[edge('a', 'b', np.eye(4)), edge('b', 'a', np.eye(4))])
    )
    assert static.lookup('base_link', 'a') is None


def test_a_late_listener_gets_the_mounting(node: Node, spin_until) -> None:
    publisher = node.create_publisher(TFMessage, '/tf_static', qos.TF_STATIC)
    publisher.publish(TFMessage(transforms=[edge('base_link', 'lidar', se3.rotation_z(0.3))]))
    late = Node('late')
    try:
        static = StaticTransforms(late)
        assert spin_until([node, late], lambda: static.lookup('base_link', 'lidar') is not None)
    finally:
        late.destroy_node()


def test_a_second_authority_is_noticed_and_the_own_echo_is_not(node: Node) -> None:
    authority = TransformAuthority(node, 'map', 'odom')
    T = se3.rotation_z(0.1)
    authority.send(T, 5)
    authority.on_tf(TFMessage(transforms=[edge('map', 'odom', T, 5)]))
    authority.on_tf(TFMessage(transforms=[edge('odom', 'base_link', T, 5)]))
    assert authority.rivals == 0
    authority.on_tf(TFMessage(transforms=[edge('map', 'odom', se3.rotation_z(0.2), 5)]))
    assert authority.rivals == 1
    authority.on_tf(TFMessage(transforms=[edge('map', 'odom', T, 6)]))
    assert authority.rivals == 2


def test_another_parent_of_the_child_is_noticed(node: Node) -> None:
    authority = TransformAuthority(node, 'map', 'base_link')
    T = se3.rotation_z(0.1)
    authority.send(T, 5)
    authority.on_tf(
        TFMessage(
            transforms=[
                edge('/map', '/base_link', T, 5),
                edge('base_link', 'wheel', T, 5),
                edge('map', 'odom', T, 5),
                edge('map', 'base_link_front', T, 5),
            ]
        )
    )
    assert authority.rivals == 0
    authority.on_tf(TFMessage(transforms=[edge('odom', 'base_link', T, 5)]))
    assert authority.rivals == 1, 'equal numbers are no excuse: odom is no map'
