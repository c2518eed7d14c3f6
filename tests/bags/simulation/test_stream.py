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
    measured_sweep,
)
from bags.simulation.town import SimulatedTown
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
    drawn, _ = measured_sweep(LidarRaster(scene, model), T, 5.0, rng)
    cast = LidarSensor(model, EmbreeCaster(scene)).sweep(T, 5.0, rng).cloud.xyz
    exact = LidarSensor(replace(model, elevation_bias_rad=0.0), EmbreeCaster(scene))
    true = exact.sweep(T, 5.0, rng).cloud.xyz
    assert np.median(cKDTree(cast).query(drawn.numpy())[0]) < 0.005
    heights = []
    for xyz in (drawn.numpy(), cast, true):
        range_m = np.linalg.norm(xyz, axis=1)
        heights.append(np.median(xyz[(np.abs(range_m - 10.0) < 2.0) & (xyz[:, 2] < -1.0), 2]))
    assert heights[:2] == pytest.approx([heights[2] - 0.065] * 2, abs=0.02)


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
