"""Settings are checked when a config is built, and described once."""

import dataclasses

import pytest

from lcd_common.errors import ConfigError
from lcd_common.settings import config, describe, from_mapping, setting


@config
class Example:
    """Settings of an example."""

    size: float = setting(0.5, 'edge of a voxel', unit='m', low=0.01, high=10.0)
    count: int = setting(3, 'tries', low=1)
    method: str = setting('a', 'which way', choices=('a', 'b'))
    enabled: bool = setting(True, 'do it')


def test_defaults_and_plain_python() -> None:
    example = Example(size=1, count=5)
    assert example.size == 1.0 and isinstance(example.size, float)
    assert example.count == 5 and example.method == 'a' and example.enabled
    with pytest.raises(dataclasses.FrozenInstanceError):
        example.size = 2.0  # type: ignore[misc]


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'size': 0.0}, r'size must be at least 0.01 m, got 0'),
        ({'size': 11.0}, r'size must be at most 10 m, got 11'),
        ({'size': float('nan')}, r'size must be a number, got NaN'),
        ({'size': 'big'}, r"size must be float, got str 'big'"),
        ({'count': 2.5}, r'count must be int, got float 2.5'),
        ({'count': True}, r'count must be int, got bool True'),
        ({'method': 'c'}, r"method must be one of a, b, got 'c'"),
        ({'enabled': 1}, r'enabled must be bool, got int 1'),
        ({'sice': 1.0}, r'Example has no setting sice; it has size, count, method, enabled'),
    ],
)
def test_wrong_values_say_what_was_expected(values: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_mapping(Example, values)


def test_describe_lists_unit_range_and_choices() -> None:
    rows = describe(Example)
    assert rows[0] == ('size', '0.5', 'm', '0.01 .. 10', 'edge of a voxel')
    assert rows[1][3] == '1 .. inf'
    assert rows[2][3] == 'a | b'
