"""How fast the simulator is, and whether its two renderers agree."""

import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from bags.simulation.drive import SensorsConfig, SimulatedDrive
from bags.simulation.embree import EmbreeCaster
from bags.simulation.itinerary import JourneyConfig
from bags.simulation.journey import Journey
from bags.simulation.lidar_model import LIDARS
from bags.simulation.raster import LidarRaster
from bags.simulation.stream import TEST_SEEDS, measured_sweeps
from bags.simulation.town import SimulatedTown
from lcd_common import se3

_WITHIN_M = 0.01


def evaluate(work: Path, sweeps: int = 100, frames: int = 40) -> dict[str, Any]:
    """Time HDL-64E sweeps of 120,000 rays and camera frames of 1241 x 376 along a drive."""
    del work
    drive = SimulatedDrive(
        TEST_SEEDS[0], journey=JourneyConfig(length=300.0), sensors=SensorsConfig(camera=True)
    )
    drive.sweep(0), drive.image(0)  # the first builds the trees
    begin = time.perf_counter()
    points = [len(drive.sweep(2 * k).cloud) for k in range(sweeps)]
    sweep_s = (time.perf_counter() - begin) / sweeps
    begin = time.perf_counter()
    for k in range(frames):
        drive.image(5 * k)
    frame_s = (time.perf_counter() - begin) / frames
    return {
        'sweeps_per_second_cpu': 1.0 / sweep_s,
        'points_per_sweep': float(np.mean(points)),
        'rays_per_sweep': LIDARS['hdl64'].rays,
        'camera_frames_per_second_cpu': 1.0 / frame_s,
        'sweeps_per_second_torch_cpu': _torch_rate('cpu', 20, 1),
        'sweeps_per_second_gpu': _torch_rate('cuda', 512, 16)
        if torch.cuda.is_available()
        else None,
    }


def _torch_rate(device: str, sweeps: int, batch: int) -> float:
    town, rng = SimulatedTown(TEST_SEEDS[0]), np.random.default_rng(0)
    journey = Journey(town.streets, town.ground, JourneyConfig(length=300.0), seed=0, run=0)
    raster = LidarRaster(town.scene(0), LIDARS['hdl64'], device)
    times = np.linspace(0.0, journey.duration_s, sweeps)
    poses = journey.T_world_base(times) @ _UP
    measured_sweeps(raster, poses[:batch], times[:batch], rng)
    begin = time.perf_counter()
    for k in range(0, sweeps, batch):
        points, _ = measured_sweeps(raster, poses[k : k + batch], times[k : k + batch], rng)[-1]
    float(points.sum())  # waits for the device
    return sweeps / (time.perf_counter() - begin)


def renderers(work: Path, poses: int = 60) -> dict[str, Any]:
    """Cast the same rays with Embree and with torch; return the share within a centimetre."""
    del work
    shares, label_shares = [], []
    for seed in TEST_SEEDS[:2]:
        drive = SimulatedDrive(seed, journey=JourneyConfig(length=600.0))
        scene = drive.town.scene(0)
        caster = EmbreeCaster(scene)
        raster = LidarRaster(scene, LIDARS['hdl64'])
        times = np.linspace(0.0, drive.journey.duration_s, poses // 2)
        for number, time_s in enumerate(times):
            model = list(LIDARS.values())[number % len(LIDARS)]
            raster.look_with(model)
            T = drive.journey.T_world_base(float(time_s))[0] @ _UP
            directions = (model.directions().reshape(-1, 3) @ T[:3, :3].T).astype(np.float32)
            hits = caster.cast(T[None, :3, 3].astype(np.float32), directions, float(time_s))
            got = raster.cast(T, float(time_s))
            a = np.where(hits.range_m > model.max_range_m, np.inf, hits.range_m)
            b = got.range_m.numpy().ravel()
            both = np.isfinite(a) & np.isfinite(b)
            near = np.abs(np.where(both, a, 0.0) - np.where(both, b, 0.0)) < _WITHIN_M
            shares.append(float(np.mean(near & (np.isfinite(a) == np.isfinite(b)))))
            label_shares.append(float(np.mean((got.label.numpy().ravel() == hits.label)[both])))
    return {
        'renderers_within_1cm_share': float(np.mean(shares)),
        'renderers_worst_sweep_share': min(shares),
        'renderers_same_label_share': float(np.mean(label_shares)),
    }


_UP = se3.from_rotation_translation(np.eye(3), [0.0, 0.0, 1.73])
