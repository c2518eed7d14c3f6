"""Declare ROS parameters from a config dataclass, so that nothing is listed twice."""

import dataclasses
from typing import TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from lcd_common.errors import ConfigError
from lcd_common.settings import from_mapping, meaning_of

Config = TypeVar('Config')
_UNBOUNDED = 1e308


def declare_config(node: Node, cls: type[Config], prefix: str = '') -> Config:
    """Declare every setting of `cls` as a parameter of `node` and return the config they make.

    A setting is read-only unless it is `live`; `current_config` re-reads those.

    Args:
        node: the node to declare on.
        cls: a class made with `lcd_common.settings.config`.
        prefix: group name, e.g. 'registration' for parameters registration.max_distance.

    Raises:
        ConfigError: a value has the wrong type or lies out of its range.
    """
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        name = f'{prefix}.{field.name}' if prefix else field.name
        default = list(field.default) if isinstance(field.default, tuple) else field.default
        try:
            node.declare_parameter(name, default, _descriptor(field))
        except ParameterException as error:
            raise ConfigError(f'parameter {name} of node {node.get_name()}: {error}') from None
    return current_config(node, cls, prefix)


def current_config(node: Node, cls: type[Config], prefix: str = '') -> Config:
    """Return the config that the node's parameters make now."""
    values = {}
    for field in dataclasses.fields(cls):  # type: ignore[arg-type]
        name = f'{prefix}.{field.name}' if prefix else field.name
        value = node.get_parameter(name).value
        values[field.name] = tuple(value) if isinstance(field.default, tuple) else value
    try:
        return from_mapping(cls, values)
    except ConfigError as error:
        raise ConfigError(
            f'node {node.get_name()}: {prefix + "." if prefix else ""}{error}'
        ) from None


def overrides(**values: object) -> list[Parameter]:
    """Make `parameter_overrides` for a node's constructor: `overrides(use_sim_time=True)`."""
    return [Parameter(name.replace('__', '.'), value=value) for name, value in values.items()]


def _descriptor(field: 'dataclasses.Field[object]') -> ParameterDescriptor:
    meaning = meaning_of(field)
    unit = f' [{meaning.unit}]' if meaning.unit else ''
    descriptor = ParameterDescriptor(
        description=meaning.description + unit,
        additional_constraints=', '.join(meaning.choices),
        read_only=not meaning.live,
    )
    low, high = meaning.low, meaning.high
    if low is None and high is None:
        return descriptor
    if isinstance(field.default, float):
        bounds = FloatingPointRange(
            from_value=float(-_UNBOUNDED if low is None else low),
            to_value=float(_UNBOUNDED if high is None else high),
        )
        descriptor.floating_point_range = [bounds]
    elif isinstance(field.default, int):
        bounds = IntegerRange(
            from_value=int(-(2**62) if low is None else low),
            to_value=int(2**62 if high is None else high),
        )
        descriptor.integer_range = [bounds]
    return descriptor
