"""Change settings as a command line tells: NAME=VALUE."""

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any, TypeVar

from lcd_common.errors import ConfigError

Settings = TypeVar('Settings')


def changed(settings: Settings, changes: Sequence[str]) -> Settings:
    """Return settings with `NAME=VALUE` changes; raises ConfigError for what there is not."""
    known = {field.name: field.default for field in fields(settings)}  # type: ignore[arg-type]
    values = {}
    for change in changes:
        name, equals, text = change.partition('=')
        if not equals or name not in known:
            raise ConfigError(
                f'{change!r} is no setting; expected NAME=VALUE, NAME one of: '
                + ', '.join(sorted(known))
            )
        try:
            values[name] = _value(text, known[name])
        except ValueError:
            kind = type(known[name]).__name__
            raise ConfigError(f'{change!r}: expected a value of type {kind}') from None
    return replace(settings, **values)  # type: ignore[type-var]


def _value(text: str, like: Any) -> Any:
    if isinstance(like, bool):
        if text.lower() not in ('true', 'false'):
            raise ValueError
        return text.lower() == 'true'
    if isinstance(like, tuple):
        kind = type(like[0]) if like else float
        return tuple(kind(part) for part in text.split(',') if part)
    return type(like)(text)
