"""Change settings as a command line tells."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from lcd_common.errors import ConfigError


def changed(settings: Any, changes: Sequence[str]) -> Any:
    """Return settings with `NAME=VALUE` changes; raises ConfigError for what there is not."""
    known = {field.name: field.default for field in fields(settings)}
    values = {}
    for change in changes:
        name, equals, text = change.partition('=')
        if not equals or name not in known:
            raise ConfigError(f'{change!r} is no setting; expected NAME=VALUE, NAME one of: '
                              + ', '.join(sorted(known)))  # fmt: skip
        try:
            values[name] = _value(text, known[name])
        except ValueError:
            kind = type(known[name]).__name__
            raise ConfigError(f'{change!r}: expected a value of type {kind}') from None
    return replace(settings, **values)


def _value(text: str, like: Any) -> Any:
    if isinstance(like, bool):
        if text.lower() not in ('true', 'false'):
            raise ValueError
        return text.lower() == 'true'
    if isinstance(like, tuple):
        return tuple(type(like[0])(part) for part in text.split(',') if part)
    return type(like)(text)
