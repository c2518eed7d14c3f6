"""Decode serialized messages into rclpy's message classes."""

from functools import cache
from importlib import import_module
from typing import Any

from rclpy.serialization import deserialize_message

from lcd_common.errors import DataError


@cache
def message_class(type_name: str) -> Any:
    """Return the class of a type written `package/msg/Name`.

    Raises:
        DataError: its package is not installed here, or has no such message.
    """
    package, _, name = type_name.partition('/')
    name = name.removeprefix('msg/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError):
        raise DataError(
            f'the message type {type_name} is not installed here; source the workspace that has '
            f'{package}, or leave its topic out'
        ) from None


def decode(data: bytes, type_name: str) -> Any:
    """Return the rclpy message that serialized bytes hold."""
    return deserialize_message(data, message_class(type_name))
