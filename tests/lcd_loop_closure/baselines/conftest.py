"""Give tests of baselines pairs of sweeps of one place, and the folder's helpers."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1]))


@pytest.fixture(scope='session')
def street_views():
    """Two pairs (match, query) of sweeps up to 4 m apart: the same way and the other way."""
    from simulated_street import pairs_apart, street, view

    from lcd_common import se3

    poses = street().truth().T_world_body
    found = {}
    for i, j in pairs_apart(1.0, 4.0):
        yaw = abs(se3.yaw(se3.inverse(poses[i]) @ poses[j]))
        if yaw < 0.2 or yaw > 2.9:
            found.setdefault(yaw > 2.9, (i, j))
    return [tuple(view(index) for index in found[reverse]) for reverse in (False, True)]
