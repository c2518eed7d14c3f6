"""Towns: the same from the same seed, others from others, streets free, runs that differ."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from bags.simulation.street_map import street_map
from bags.simulation.town import SimulatedTown
from bags.street.mesh import Label, Mesh


@pytest.fixture(scope='module')
def town() -> SimulatedTown:
    return SimulatedTown(101, size=3)


def centres(mesh: Mesh, *labels: Label) -> np.ndarray:
    chosen = np.isin(mesh.labels, labels)
    return mesh.vertices[mesh.triangles[chosen]].mean(axis=1)


@pytest.mark.parametrize('seed', range(6))
def test_streets_hang_together_and_have_crossings_and_curves(seed: int) -> None:
    streets = street_map(seed)
    i, j = np.array([(edge.i, edge.j) for edge in streets.edges]).T
    links = coo_matrix((np.ones(len(i)), (i, j)), (len(streets.nodes),) * 2)
    assert connected_components(links)[0] == 1
    degree = np.bincount(np.r_[i, j])
    assert degree.min() >= 1 and degree.max() >= 4
    assert 2500.0 < sum(edge.length_m for edge in streets.edges) < 7000.0
    for edge in streets.edges:
        ends = edge.centreline[[0, -1]]
        np.testing.assert_allclose(ends, streets.nodes[[edge.i, edge.j]], atol=1e-9)
    bows = [e.length_m / np.linalg.norm(e.centreline[-1] - e.centreline[0]) for e in streets.edges]
    assert np.mean(np.array(bows) > 1.005) > 0.2


def test_nearly_all_towns_have_dead_ends_and_none_is_made_of_them() -> None:
    dead_ends = []
    for seed in (*range(30), *range(100, 110), *range(200, 210)):
        streets = street_map(seed)
        degree = Counter(node for edge in streets.edges for node in (edge.i, edge.j))
        dead_ends.append(sum(count == 1 for count in degree.values()))
        assert dead_ends[-1] < len(streets.nodes) / 4
    assert np.mean(np.array(dead_ends) > 0) >= 0.9


def test_the_same_seed_is_the_same_town_and_another_is_not(town: SimulatedTown) -> None:
    again, other = SimulatedTown(101, size=3), SimulatedTown(102, size=3)
    for run in (0, 2):
        a, b = town.scene(run), again.scene(run)
        assert a.mesh.vertices.tobytes() == b.mesh.vertices.tobytes()
        assert a.mesh.triangles.tobytes() == b.mesh.triangles.tobytes()
        assert a.mesh.labels.tobytes() == b.mesh.labels.tobytes()
        assert len(a.movers) == len(b.movers)
        assert a.movers[0].T_world_mover.tobytes() == b.movers[0].T_world_mover.tobytes()
        np.testing.assert_array_equal(a.light.to_sun, b.light.to_sun)
    mesh = other.scene(0).mesh
    assert len(mesh.vertices) != len(town.scene(0).mesh.vertices)


def test_houses_stay_from_run_to_run_and_cars_do_not(town: SimulatedTown) -> None:
    first, second = town.scene(0).mesh, town.scene(1).mesh
    for label in (Label.BUILDING, Label.TRUNK, Label.ROAD):
        np.testing.assert_array_equal(centres(first, label), centres(second, label))
    a, b = centres(first, Label.CAR), centres(second, Label.CAR)
    assert len(a) and len(b)
    assert np.mean(cKDTree(a).query(b)[0] > 0.05) > 0.5


def test_nothing_stands_in_the_lanes(town: SimulatedTown) -> None:
    for run in (0, 1):
        mesh = town.scene(run).mesh
        solid = centres(mesh, Label.BUILDING, Label.CAR, Label.TRUNK, Label.POLE, Label.FENCE)
        above = solid[:, 2] - town.ground.height(solid[:, :2].astype(float)) > 0.3
        for edge in town.streets.edges:
            away = cKDTree(edge.centreline).query(solid[above][:, :2])[0]
            # Parked cars take the outer two metres of streets that are wide enough for them.
            assert away.min() > min(edge.half_width_m - 2.4, 3.0) - 1.1


def test_an_aliased_district_repeats_its_houses() -> None:
    aliased = SimulatedTown(200, 'aliased', size=3)
    edges = aliased.streets.edges
    assert {edge.style for edge in edges} == {'aliased'}
    walls = centres(aliased.scene(0).mesh, Label.BUILDING)
    height = walls[:, 2] - aliased.ground.height(walls[:, :2].astype(float))
    # All houses have the same few heights of wall and window pieces.
    assert len(np.unique(np.round(height, 0))) < 15
    assert not len(aliased.streets.squares)


def test_every_town_has_an_estate_on_one_side() -> None:
    for seed in (0, 104, 205):
        streets = street_map(seed)
        alike = np.array([edge.style == 'aliased' for edge in streets.edges])
        assert 0.1 < alike.mean() < 0.5
        middles = np.array([edge.centreline.mean(axis=0) for edge in streets.edges])
        # One straight line parts it from the rest, but for the bows of the streets.
        apart = middles[alike].mean(axis=0) - middles[~alike].mean(axis=0)
        assert np.linalg.norm(apart) > 100.0
        assert {e.half_width_m for e in streets.edges if e.style == 'aliased'} == {4.5}
        assert len({e.style for e in streets.edges}) >= 4


def test_squares_are_open_and_paved(town: SimulatedTown) -> None:
    mesh, (x, y, radius) = town.scene(0).mesh, town.streets.squares[0]

    def on_square(*labels: Label) -> int:
        return int(np.sum(np.linalg.norm(centres(mesh, *labels)[:, :2] - [x, y], axis=1) < radius))

    assert on_square(Label.BUILDING, Label.TRUNK, Label.FENCE) == 0
    paved, grass = on_square(Label.ROAD, Label.SIDEWALK), on_square(Label.TERRAIN)
    assert paved > 0.9 * np.pi * radius**2 and grass < 0.05 * paved


def test_every_surface_has_a_label_and_a_material(town: SimulatedTown) -> None:
    mesh = town.scene(0).mesh
    assert len(mesh.labels) == len(mesh.materials) == len(mesh.triangles)
    share = {label: float(np.mean(mesh.labels == label)) for label in Label}
    assert share[Label.UNLABELED] < 0.001
    for label in (Label.ROAD, Label.SIDEWALK, Label.TERRAIN, Label.BUILDING, Label.VEGETATION):
        assert share[label] > 0.005
    assert int(mesh.triangles.max()) < len(mesh.vertices)
    assert np.isfinite(mesh.vertices).all()
