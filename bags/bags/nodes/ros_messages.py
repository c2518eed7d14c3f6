"""Decode serialized messages into rclpy's message classes, and encode these repeatably."""

import re
from functools import cache
from importlib import import_module
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lcd_common.errors import DataError

_STORE = get_typestore(Stores.ROS2_JAZZY)
_IDL_NAMES = {'double': 'float64', 'float': 'float32', 'boolean': 'bool', 'octet': 'byte'}


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


def encode_repeatably(message: Any) -> bytes:
    """Return a message's CDR bytes, the same for equal messages.

    rclpy's own bytes are not: alignment leaves gaps, and they hold whatever was in memory.
    """
    cls: Any = type(message)
    type_name = _known_type(cls)
    fields = _STORE.deserialize_cdr(serialize_message(message), type_name)
    return bytes(_STORE.serialize_cdr(fields, type_name))


@cache
def _known_type(cls: Any) -> str:
    """Make rosbags know the type of an rclpy class and return its name."""
    type_name = f'{cls.__module__.partition(".")[0]}/msg/{cls.__name__}'
    if type_name not in _STORE.fielddefs:
        lines = [
            f'{_msg_type(text)} {name}' for name, text in cls.get_fields_and_field_types().items()
        ]
        _STORE.register(get_types_from_msg('\n'.join(lines), type_name))
    return type_name


def _msg_type(text: str) -> str:
    """Turn rclpy's spelling of a field's type into that of a .msg file."""
    sequence = re.fullmatch(r'sequence<(.+?)(?:, (\d+))?>', text)
    if sequence:
        bound = f'<={sequence[2]}' if sequence[2] else ''
        return f'{_msg_type(sequence[1])}[{bound}]'
    array = re.fullmatch(r'(.+)\[(\d+)\]', text)
    if array:
        return f'{_msg_type(array[1])}[{array[2]}]'
    if '/' in text:
        return _known_type(message_class(text))
    return _IDL_NAMES.get(text, text.partition('<')[0])
