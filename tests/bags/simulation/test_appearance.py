"""Check the colours of surfaces where a random number is as large as it gets."""

import itertools

import numpy as np
import pytest

from bags.simulation import appearance
from bags.street.mesh import Label, Material, Mesh


def all_kinds() -> Mesh:
    """A wall of each material under each label, five metres from the next."""
    pairs = np.array(list(itertools.product(Material, Label)))
    corners = np.array([[0, 0, 0], [2, 0, 0], [0, 0, 2]], np.float32)
    at = 5.0 * np.arange(len(pairs))[:, None] * [0.0, 1.0, 0.0]
    vertices = (corners[None] + at[:, None]).reshape(-1, 3).astype(np.float32)
    triangles = np.arange(3 * len(pairs), dtype=np.uint32).reshape(-1, 3)
    return Mesh(vertices, triangles, pairs[:, 0].astype(np.uint8), pairs[:, 1].astype(np.uint8))


# The largest below 1 in double precision is 1 in single precision.
@pytest.mark.parametrize('number', [0.0, 1.0 - 2.0**-53])
def test_every_random_number_picks_a_colour(monkeypatch, number):
    monkeypatch.setattr(appearance, 'position_hash', lambda at, seed: np.full(len(at), number))
    mesh = all_kinds()
    found = appearance.appearance_of(mesh, 0)
    assert len(np.unique(found.kind)) > 8
    assert (found.pick >= 0.0).all() and (found.pick < 1.0).all()
    assert np.isfinite(found.tint).all() and (found.tint > 0.0).all()
