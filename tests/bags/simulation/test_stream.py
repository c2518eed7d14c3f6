"""Sweeps for training: repeatable, of one place, with true poses."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from bags.simulation.embree import EmbreeCaster
from bags.simulation.lidar import LidarSensor
from bags.simulation.lidar_model import lidar_model
from bags.simulation.raster import LidarRaster
from bags.simulation.reflectivity import patchiness
from bags.simulation.stream import (
    TEST_SEEDS,
    TRAIN_SEEDS,
    VALIDATION_SEEDS,
    StreamConfig,
    SweepStream,
    measured_sweeps,
)
from bags.simulation.town import SimulatedTown
from lcd_common import se3
from lcd_common.errors import ConfigError

SMALL = StreamConfig(sensors=('vlp16', 'os1_64'), sweeps_per_town=8, towns_held=1, runs=2)


def world(sweep) -> np.ndarray:
    T = sweep.T_world_lidar
    return sweep.xyz.numpy() @ T[:3, :3].T + T[:3, 3]


def test_splits_do_not_share_towns() -> None:
    splits = [set(seeds) for seeds in (TRAIN_SEEDS, VALIDATION_SEEDS, TEST_SEEDS)]
    assert [len(split) for split in splits] == [100, 10, 10]
    assert len(set.union(*splits)) == 120


def test_pairs_show_one_place_within_the_distance() -> None:
    stream = SweepStream(TRAIN_SEEDS[:2], SMALL)
    headings = []
    for a, b in islice(stream.pairs(max_distance_m=4.0), 6):
        assert (a.town, a.sensor) == (b.town, b.sensor)
        assert np.linalg.norm(a.T_world_lidar[:3, 3] - b.T_world_lidar[:3, 3]) <= 4.0
        headings.append(float(a.T_world_lidar[:3, 0] @ b.T_world_lidar[:3, 0]))
        near = np.linalg.norm(a.xyz.numpy(), axis=1) < 15.0
        away = cKDTree(world(b)).query(world(a)[near])[0]
        # No more than the spacing of the rings, which lie two degrees apart on a VLP-16.
        assert np.median(away) < {'vlp16': 15.0 * np.radians(2.0), 'os1_64': 0.3}[a.sensor]
        assert a.xyz.dtype == torch.float32 and len(a.intensity) == len(a.xyz)
        assert float(a.intensity.min()) >= 0.0 and float(a.intensity.max()) <= 1.0
    assert min(headings) < -0.9 and max(headings) > 0.9


@pytest.mark.parametrize('caster', ['embree', 'torch'])
def test_places_hold_sweeps_as_far_apart_as_asked(caster: str) -> None:
    settings = replace(SMALL, caster=caster, sensors=('vlp16',))
    stream = SweepStream(TRAIN_SEEDS[:1], settings)
    for sweeps in islice(stream.places([(0.0, 4.0), (4.0, 15.0)]), 3):
        at = [sweep.T_world_lidar[:3, 3] for sweep in sweeps]
        near, far = (float(np.linalg.norm(at[k] - at[0])) for k in (1, 2))
        assert near <= 4.0 < far <= 15.0
        for sweep in sweeps:
            assert 1.6 <= sweep.height_m <= 1.9
            below = sweep.xyz.numpy()[np.linalg.norm(sweep.xyz.numpy()[:, :2], axis=1) < 8.0, 2]
            assert abs(float(np.percentile(below, 5)) + sweep.height_m) < 0.35


def test_both_casters_measure_with_the_same_calibration() -> None:
    """Without noise both renderers give the same points, put too low by the elevation's bias."""
    model = replace(
        lidar_model('hdl64_kitti'), columns=180, range_sigma_m=0.0, beam_sigma_m=0.0,
        angle_sigma_rad=0.0,
    )  # fmt: skip
    town = SimulatedTown(3, size=3)
    scene = town.scene(0)
    edge = town.streets.edges[0]
    T, rng = np.eye(4), np.random.default_rng(0)
    T[:2, 3] = edge.at(0.5 * edge.length_m)[0]
    T[2, 3] = float(town.ground.height(T[None, :2, 3])[0]) + 1.73
    drawn, _ = measured_sweeps(LidarRaster(scene, model), T[None], np.array([5.0]), rng)[0]
    cast = LidarSensor(model, EmbreeCaster(scene)).sweep(T, 5.0, rng).cloud.xyz
    exact = LidarSensor(replace(model, elevation_bias_rad=0.0), EmbreeCaster(scene))
    true = exact.sweep(T, 5.0, rng).cloud.xyz
    assert np.median(cKDTree(cast).query(drawn.numpy())[0]) < 0.005
    heights = []
    for xyz in (drawn.numpy(), cast, true):
        range_m = np.linalg.norm(xyz, axis=1)
        heights.append(np.median(xyz[(np.abs(range_m - 10.0) < 2.0) & (xyz[:, 2] < -1.0), 2]))
    assert heights[:2] == pytest.approx([heights[2] - 0.065] * 2, abs=0.02)


def test_sweeps_cast_at_once_are_those_cast_one_by_one() -> None:
    model = replace(
        lidar_model('vlp16'), range_sigma_m=0.0, beam_sigma_m=0.0, angle_sigma_rad=0.0, dropout=0.0,
        divergence_rad=0.0, reach_m=1e4,
    )  # fmt: skip
    town = SimulatedTown(3, size=3)
    raster, edges = LidarRaster(town.scene(0), model), town.streets.edges[:3]
    poses = np.stack([se3.rotation_z(0.4 * k) for k in range(3)])
    for T, edge in zip(poses, edges, strict=True):
        T[:2, 3] = edge.at(0.5 * edge.length_m)[0]
        T[2, 3] = float(town.ground.height(T[None, :2, 3])[0]) + 1.73
    times = np.array([5.0, 50.0, 200.0])
    hits = raster.cast(poses, times)
    assert hits.range_m.shape == (3, model.columns, 16)
    for k in range(3):
        one = raster.cast(poses[k], times[k])
        for name in ('range_m', 'incidence', 'triangle', 'material', 'label', 'moving'):
            assert torch.equal(getattr(hits, name)[k], getattr(one, name)), name
    # And measured: glass loses returns at random, what is left lies where the rays end.
    for k, (xyz, _) in enumerate(measured_sweeps(raster, poses, times, np.random.default_rng(0))):
        ends = (raster.directions * hits.range_m[k][..., None])[torch.isfinite(hits.range_m[k])]
        assert 0.8 * len(ends) < len(xyz) <= len(ends)
        assert cKDTree(ends.numpy()).query(xyz.numpy())[0].max() < 0.002


@pytest.mark.parametrize('by_torch', [True, False])
def test_two_echoes_are_those_of_one_and_the_surfaces_behind(by_torch: bool) -> None:
    model = replace(lidar_model('os1_64'), dropout=0.0)
    town = SimulatedTown(3, size=3)
    edge, T = town.streets.edges[0], np.eye(4)
    T[:2, 3] = edge.at(0.5 * edge.length_m)[0]
    T[2, 3] = float(town.ground.height(T[None, :2, 3])[0]) + 1.73
    scene, counts = town.scene(0), []
    for dual in (False, True):
        lidar = replace(model, dual_return=dual)
        if by_torch:
            raster = LidarRaster(scene, lidar)
            rng = np.random.default_rng(0)
            counts.append(len(measured_sweeps(raster, T[None], np.zeros(1), rng)[0][0]))
            continue
        sensor = LidarSensor(lidar, EmbreeCaster(scene))
        sweep = sensor.sweep(T, 0.0, np.random.default_rng(0))
        counts.append(len(sweep.cloud))
        twice = np.flatnonzero(np.diff(sweep.ray) == 0)
        assert np.all(np.diff(sweep.ray) >= 0)
        if dual:
            range_m = np.linalg.norm(sweep.cloud.xyz, axis=1)
            # Echoes nearer to each other than a metre melt into one.
            assert len(twice) > 100 and np.abs(range_m[twice] - range_m[twice + 1]).min() > 0.8
        else:
            assert not len(twice)
    assert counts[0] * 1.003 < counts[1] < counts[0] * 1.2


def test_the_same_seed_streams_the_same_sweeps() -> None:
    def first(seed: int):
        return next(SweepStream([3], SMALL, seed=seed).sweeps())

    a, b, other = first(5), first(5), first(6)
    assert torch.equal(a.xyz, b.xyz) and torch.equal(a.intensity, b.intensity)
    assert a.xyz.shape != other.xyz.shape or not torch.equal(a.xyz, other.xyz)


def test_blocked_sectors_hold_no_points() -> None:
    settings = StreamConfig(sensors=('vlp16',), towns_held=1, runs=1, blocked_deg=(90.0,))
    for sweep in islice(SweepStream([4], settings).sweeps(), 3):
        azimuth = np.degrees(np.arctan2(sweep.xyz[:, 1].numpy(), sweep.xyz[:, 0].numpy()))
        edges = np.sort(azimuth % 360.0)
        gap = np.diff(np.r_[edges, edges[0] + 360.0]).max()
        assert 89.0 < gap < 140.0


def test_patches_are_those_of_the_numpy_sensor() -> None:
    xyz = np.random.default_rng(0).uniform(-300.0, 300.0, (5000, 3)).astype(np.float32)
    np.testing.assert_allclose(patchiness(torch.as_tensor(xyz), torch).numpy(), patchiness(xyz))


def test_mistakes_are_told() -> None:
    with pytest.raises(ConfigError, match='at least one town'):
        SweepStream([])
    with pytest.raises(ConfigError, match='the caster is auto'):
        SweepStream([1], StreamConfig(caster='optix'))
    with pytest.raises(ConfigError, match='a lidar is one of'):
        SweepStream([1], StreamConfig(sensors=('sick',)))
