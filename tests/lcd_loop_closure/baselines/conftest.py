"""Give tests of baselines pairs of sweeps of one place, and the folder's helpers."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1]))


@pytest.fixture(scope='session')
def street_views():
    """Two pairs (match, query) of sweeps up to 4 m apart: the same way and the other way."""
    from simulated_street import pairs_apart, relative, view

    from lcd_common import se3

    found = {}
    for i, j in pairs_apart(1.0, 4.0):
        match, query = view(i), view(j)
        yaw = abs(se3.yaw(relative(match, query)))
        if yaw < 0.2 or yaw > 2.9:
            found.setdefault(yaw > 2.9, (match, query))
        if len(found) == 2:
            break
    return [found[False], found[True]]
