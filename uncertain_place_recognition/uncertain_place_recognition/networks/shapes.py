"""Build a network by its name and shape."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from lcd_common.errors import ConfigError
from lcd_common.settings import from_mapping
from uncertain_place_recognition.networks import bev_netvlad, minkloc3d, pointnetvlad
from uncertain_place_recognition.networks.embedding import PlaceNetwork

# name -> (network, config, {preset: config})
_SHAPES: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    'minkloc3d': (
        minkloc3d.MinkLoc3d,
        minkloc3d.MinkLoc3dConfig,
        {'original': minkloc3d.ORIGINAL, 'compact': minkloc3d.COMPACT},
    ),
    'pointnetvlad': (
        pointnetvlad.PointNetVlad,
        pointnetvlad.PointNetVladConfig,
        {
            'original': pointnetvlad.ORIGINAL,
            'port': pointnetvlad.PORT,
            'compact': pointnetvlad.COMPACT,
        },
    ),
    'bev_netvlad': (
        bev_netvlad.BevNetVlad,
        bev_netvlad.BevNetVladConfig,
        {'original': bev_netvlad.ORIGINAL, 'compact': bev_netvlad.COMPACT},
    ),
}
NETWORKS = tuple(_SHAPES)


def shape(name: str, preset: str = 'compact', **changes: Any) -> Any:
    """Return the configuration of a network, with changes.

    Raises:
        ConfigError: there is no network, preset or setting of a name.
    """
    presets = _known(name)[2]
    if preset not in presets:
        raise ConfigError(f'{name} has no preset {preset!r}; it has {", ".join(presets)}')
    return replace(presets[preset], **changes) if changes else presets[preset]


def build(settings: Any) -> PlaceNetwork:
    """Return an untrained network of a configuration."""
    network: PlaceNetwork = _known(name_of(settings))[0](settings)
    return network


def name_of(settings: Any) -> str:
    """Return the name of the network that a configuration is of."""
    for name, (_, config, _) in _SHAPES.items():
        if isinstance(settings, config):
            return name
    raise ConfigError(f'{type(settings).__name__} is no configuration of a network here')


def settings_from(name: str, values: Mapping[str, Any]) -> Any:
    """Return the configuration that JSON values stand for."""
    whole = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
    return from_mapping(_known(name)[1], whole)


def _known(name: str) -> tuple[Any, Any, dict[str, Any]]:
    if name not in _SHAPES:
        raise ConfigError(f'no network {name!r}; there are {", ".join(NETWORKS)}')
    return _SHAPES[name]
