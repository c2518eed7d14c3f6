"""Describe configuration once: frozen dataclasses whose fields carry meaning, unit and range.

The same dataclass is plain Python for scripts and tests, a set of ROS parameters for nodes
(`lcd_common.nodes.parameters.declare_config`) and a table for the README (`describe`).
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar, dataclass_transform

from lcd_common.errors import ConfigError

Config = TypeVar('Config')
_KEY = 'setting'


@dataclasses.dataclass(frozen=True)
class Setting:
    """Meaning of one configuration field; `low` and `high` are inclusive, None is unbounded."""

    description: str
    unit: str = ''
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    live: bool = False

    def check(self, name: str, value: Any) -> None:
        """Raise ConfigError when `value` is not finite, out of range or not one of the choices."""
        if self.choices and value not in self.choices:
            raise ConfigError(f'{name} must be one of {", ".join(self.choices)}, got {value!r}')
        if isinstance(value, bool) or not isinstance(value, int | float):
            return
        unit = f' {self.unit}' if self.unit else ''
        if value != value:
            raise ConfigError(f'{name} must be a number, got NaN')
        if self.low is not None and value < self.low:
            raise ConfigError(f'{name} must be at least {self.low:g}{unit}, got {value:g}')
        if self.high is not None and value > self.high:
            raise ConfigError(f'{name} must be at most {self.high:g}{unit}, got {value:g}')


def setting(
    default: Any,
    description: str,
    *,
    unit: str = '',
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    live: bool = False,
) -> Any:
    """Declare a field of a config dataclass.

    Args:
        default: its default; the type of the default is the type of the parameter (bool, int,
            float, str, or tuple of one of these).
        description: one phrase for people, without the unit.
        unit: e.g. 'm', 's', 'rad'; empty for counts, shares and names.
        low: smallest allowed value, inclusive.
        high: largest allowed value, inclusive.
        choices: the allowed values of a name.
        live: True when a running node may change it; it must then be read afresh at every use.
    """
    meaning = Setting(description, unit, low, high, choices, live)
    return dataclasses.field(default=default, metadata={_KEY: meaning})


# `setting` is no field specifier: without the keyword default= checkers would take it for required.
@dataclass_transform(frozen_default=True)
def config(cls: type[Config]) -> type[Config]:
    """Make `cls` a frozen dataclass that checks its settings whenever it is built."""

    def __post_init__(self: Any) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            expected = type(field.default)
            if expected is float and type(value) is int:
                object.__setattr__(self, field.name, float(value))
            elif not isinstance(value, expected) or (expected is int and isinstance(value, bool)):
                raise ConfigError(
                    f'{field.name} must be {expected.__name__}, '
                    f'got {type(value).__name__} {value!r}'
                )
            meaning_of(field).check(field.name, getattr(self, field.name))

    cls.__post_init__ = __post_init__  # type: ignore[attr-defined]
    return dataclasses.dataclass(frozen=True)(cls)


def meaning_of(field: 'dataclasses.Field[Any]') -> Setting:
    """Return the Setting of a field declared with `setting`."""
    meaning: Setting = field.metadata[_KEY]
    return meaning


def from_mapping(cls: type[Config], values: Mapping[str, Any]) -> Config:
    """Build a config from names and values; an unknown name raises ConfigError."""
    known = [field.name for field in dataclasses.fields(cls)]  # type: ignore[arg-type]
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise ConfigError(
            f'{cls.__name__} has no setting {", ".join(unknown)}; it has {", ".join(known)}'
        )
    return cls(**values)


def describe(cls: type[Any]) -> list[tuple[str, str, str, str, str]]:
    """List (name, default, unit, range, description) of every setting of a config class."""
    rows = []
    for field in dataclasses.fields(cls):
        meaning = meaning_of(field)
        bounds = ' | '.join(meaning.choices)
        if meaning.low is not None or meaning.high is not None:
            low = '-inf' if meaning.low is None else f'{meaning.low:g}'
            high = 'inf' if meaning.high is None else f'{meaning.high:g}'
            bounds = f'{low} .. {high}'
        rows.append((field.name, repr(field.default), meaning.unit, bounds, meaning.description))
    return rows
