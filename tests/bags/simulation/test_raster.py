"""The torch renderer against Embree: the same rays hit the same things."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from bags.simulation.embree import EmbreeCaster
from bags.simulation.hits import Hits
from bags.simulation.lidar_model import LIDARS, LidarModel
from bags.simulation.raster import LidarRaster, RasterHits
from bags.simulation.scene import Mover, Scene
from bags.simulation.town import SimulatedTown
from bags.street.mesh import Label, Material, MeshBuilder
from lcd_common import se3


@pytest.fixture(scope='module')
def town() -> SimulatedTown:
    return SimulatedTown(100, size=3)


def poses(town: SimulatedTown) -> list[np.ndarray]:
    out = []
    for k, edge in enumerate(town.streets.edges[::3]):
        xy = edge.centreline[len(edge.centreline) // (2 + k % 3)]
        T = se3.exp(np.array([0.0, 0.0, 0.0, 0.03, -0.02, 0.7 * k]))
        T[:3, 3] = *xy, town.ground.height(xy[None])[0] + 1.73
        out.append(T)
    return out


def by_embree(caster: EmbreeCaster, model: LidarModel, T: np.ndarray, time_s: float) -> Hits:
    directions = model.directions().reshape(-1, 3) @ T[:3, :3].T
    origins = np.broadcast_to(T[:3, 3], directions.shape)
    return caster.cast(origins.astype(np.float32), directions.astype(np.float32), time_s)


def agreement(expected: Hits, got: RasterHits, model: LidarModel) -> np.ndarray:
    a = np.where(expected.range_m > model.max_range_m, np.inf, expected.range_m)
    b = got.range_m.numpy().ravel()
    both = np.isfinite(a) & np.isfinite(b)
    near = np.abs(np.where(both, a, 0.0) - np.where(both, b, 0.0)) < 0.01
    return near & (np.isfinite(a) == np.isfinite(b))


@pytest.mark.parametrize('name', ['hdl64', 'os1_64', 'vlp16'])
def test_ranges_agree_within_a_centimetre(town: SimulatedTown, name: str) -> None:
    scene, model = town.scene(1), LIDARS[name]
    caster, raster = EmbreeCaster(scene), LidarRaster(scene, model)
    for T in poses(town):
        expected, got = by_embree(caster, model, T, 100.0), raster.cast(T, 100.0)
        same = agreement(expected, got, model)
        assert same.mean() > 0.999
        hit = same & np.isfinite(got.range_m.numpy().ravel())
        assert (got.label.numpy().ravel() == expected.label)[hit].mean() > 0.999
        assert (got.material.numpy().ravel() == expected.material)[hit].mean() > 0.999
        off = np.abs(got.incidence.numpy().ravel() - expected.incidence)[hit]
        assert np.quantile(off, 0.999) < 0.01


def test_movers_are_where_they_are_at_that_time() -> None:
    mesh, car = MeshBuilder(), MeshBuilder()
    mesh.box(np.array([0.0, 0.0, -0.5]), (200.0, 200.0, 1.0), 0.0, Material.ASPHALT)
    car.label = Label.CAR
    car.box(np.array([0.0, 0.0, 0.8]), (4.0, 2.0, 1.6), 0.0, Material.METAL)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[:, 0, 3] = 5.0, 45.0
    scene = Scene(mesh.build(), (Mover(car.build(), np.array([0.0, 4.0]), T),))
    model, at = LIDARS['hdl64'], np.eye(4)
    at[2, 3] = 1.5
    raster = LidarRaster(scene, model)
    for time_s, front_m in ((1.0, 13.0), (2.0, 23.0)):
        got = raster.cast(at, time_s)
        assert (
            agreement(by_embree(EmbreeCaster(scene), model, at, time_s), got, model).mean() > 0.999
        )
        assert set(got.label[got.moving].tolist()) == {int(Label.MOVING_CAR)}
        x = (raster.directions[..., 0] * got.range_m)[got.moving]
        assert float(x.min()) == pytest.approx(front_m, abs=0.01)
        assert torch.all(got.triangle[got.moving] == -1)
    assert not raster.cast(at, 5.0).moving.any()


def test_inside_a_box_every_ray_has_the_analytic_range() -> None:
    mesh = MeshBuilder()
    mesh.box(np.zeros(3), (20.0, 12.0, 6.0), 0.0, Material.PLASTER)
    model = LIDARS['os1_64']
    T = se3.exp(np.array([2.0, -1.0, 0.5, 0.1, 0.2, 0.3]))
    got = LidarRaster(Scene(mesh.build()), model).cast(T).range_m.numpy()
    directions = model.directions() @ T[:3, :3].T
    with np.errstate(divide='ignore'):
        walls = (np.sign(directions) * [10.0, 6.0, 3.0] - T[:3, 3]) / directions
    np.testing.assert_allclose(got, walls.min(axis=2), rtol=2e-5)


def test_nothing_in_sight_is_nothing() -> None:
    mesh = MeshBuilder()
    mesh.box(np.array([500.0, 0.0, 0.0]), (1.0, 1.0, 1.0), 0.0, Material.PLASTER)
    got = LidarRaster(Scene(mesh.build()), LIDARS['vlp16']).cast(np.eye(4))
    assert torch.isinf(got.range_m).all() and (got.triangle == -1).all()
    assert not got.moving.any() and not got.incidence.any()
