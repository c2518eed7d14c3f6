"""Declare the parameters of several stages, one group each."""

from dataclasses import fields
from typing import Any, TypeVar

from rclpy.node import Node

from lcd_common.nodes.parameters import declare_config

Groups = TypeVar('Groups')


def declare_groups(node: Node, defaults: Groups) -> Groups:
    """Declare `<group>.<setting>` for every field of a dataclass of configs.

    Returns:
        The same dataclass with what the parameters say.
    """
    groups: dict[str, Any] = {
        group.name: declare_config(node, type(getattr(defaults, group.name)), group.name)
        for group in fields(defaults)  # type: ignore[arg-type]
    }
    return type(defaults)(**groups)
