"""ROS parameters come from the config dataclass alone: type, range, unit and liveness."""

import pytest
from rclpy.node import Node
from rclpy.parameter import Parameter

from lcd_common.errors import ConfigError
from lcd_common.nodes.parameters import current_config, declare_config, overrides
from lcd_common.settings import config, setting

pytestmark = [pytest.mark.ros, pytest.mark.usefixtures('ros')]


@config
class Example:
    """Settings of an example."""

    size: float = setting(0.5, 'edge of a voxel', unit='m', low=0.01, high=10.0)
    limit: float = setting(0.3, 'threshold', low=0.0, live=True)
    count: int = setting(3, 'tries', low=1)
    axes: tuple = setting((1.0, 2.0), 'per axis', unit='m')
    method: str = setting('a', 'which way', choices=('a', 'b'))


def test_defaults_overrides_and_groups() -> None:
    node = Node('p', parameter_overrides=overrides(size=2.0, group__count=7, group__axes=[3.0]))
    try:
        assert declare_config(node, Example) == Example(size=2.0)
        assert declare_config(node, Example, 'group') == Example(count=7, axes=(3.0,))
        descriptor = node.describe_parameter('size')
        assert descriptor.description == 'edge of a voxel [m]'
        assert descriptor.read_only
        assert descriptor.floating_point_range[0].to_value == 10.0
        assert node.describe_parameter('count').integer_range[0].from_value == 1
    finally:
        node.destroy_node()


def test_only_live_settings_change_and_only_within_their_range() -> None:
    node = Node('p')
    try:
        declare_config(node, Example)

        def set_parameter(name, value):
            return node.set_parameters([Parameter(name, value=value)])[0]

        assert set_parameter('limit', 0.9).successful
        assert not set_parameter('limit', -1.0).successful
        assert not set_parameter('size', 1.0).successful
        assert current_config(node, Example) == Example(limit=0.9)
    finally:
        node.destroy_node()


@pytest.mark.parametrize(
    ('values', 'text'),
    [({'size': 99.0}, 'size'), ({'size': 'x'}, 'size'), ({'method': 'c'}, 'one of a, b')],
)
def test_wrong_values_are_one_clear_error(values: dict[str, object], text: str) -> None:
    node = Node('p', parameter_overrides=overrides(**values))
    try:
        with pytest.raises(ConfigError, match=text):
            declare_config(node, Example)
    finally:
        node.destroy_node()
