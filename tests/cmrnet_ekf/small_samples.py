"""A small network, and samples of a street for it."""

from collections.abc import Collection, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from camera_scenes import ground, wall

from bags.records import CameraImage, CameraModel, ImuSample, Mounting
from cmrnet_ekf.mapping.local_map import LocalMap
from cmrnet_ekf.mapping.map_builder import MapBuilder
from cmrnet_ekf.mapping.settings import MapConfig
from cmrnet_ekf.mapping.tile_folder import TileFolder
from cmrnet_ekf.networks.config import COMPACT
from cmrnet_ekf.pose_sampling import STAGES, T_OPTICAL_BODY
from cmrnet_ekf.training.sample_maker import SamplesConfig, make_samples
from cmrnet_ekf.training.sample_set import SampleSet
from lcd_common import se3
from lcd_common.cloud import PointCloud
from lcd_common.trajectory import Trajectory

SMALL = replace(
    COMPACT, width=64, height=32, focal=40.0, pyramid=(4, 6, 8), estimator=(8, 8), hidden=16,
    branch=8, squeezed=4, pooled_rows=2, pooled_columns=4,
)  # fmt: skip
T_BASE_CAMERA = se3.from_rotation_translation(se3.inverse(T_OPTICAL_BODY)[:3, :3], [1.0, 0, 1.65])
CAMERA = CameraModel('camera', 128, 60, np.array([[80.0, 0, 63.0], [0, 80.0, 28.0], [0, 0, 1.0]]))


class StreetWithCamera:
    """A drive of ten images; each is noise of its own."""

    name, path, camera = 'made_up_street', Path('made_up_street'), CAMERA
    mountings = (Mounting('base_link', 'camera', T_BASE_CAMERA),)

    def __init__(self) -> None:
        self.stamps_ns = 10**9 + np.arange(10) * 10**8

    def truth(self) -> Trajectory:
        T = np.tile(np.eye(4), (10, 1, 1))
        T[:, 0, 3] = np.arange(10) * 1.5
        return Trajectory(self.stamps_ns, T)

    def image(self, index: int) -> CameraImage:
        pixels = np.random.default_rng(index).integers(0, 256, (60, 128, 3), np.uint8)
        return CameraImage(int(self.stamps_ns[index]), pixels)

    def records(self, start_ns=None, end_ns=None, kinds: Collection = ()) -> Iterator[CameraImage]:
        for index, stamp_ns in enumerate(self.stamps_ns):
            if kinds and CameraImage not in kinds:
                return
            if (start_ns or 0) <= stamp_ns <= (end_ns or 10**18):
                yield self.image(index)


class BendWithImu(StreetWithCamera):
    """The same images along a bend of constant turn rate, with an inertial sensor that tells it."""

    name, turn_rate = 'bend', 0.2
    mountings = (
        *StreetWithCamera.mountings,
        Mounting('base_link', 'imu', np.diag([1.0, -1, -1, 1])),
    )

    def truth(self) -> Trajectory:
        yaw = self.turn_rate * np.arange(10) * 0.1
        radius = 15.0 / self.turn_rate
        T = np.array([se3.rotation_z(float(y)) for y in yaw])
        T[:, 0, 3], T[:, 1, 3] = radius * np.sin(yaw), radius * (1 - np.cos(yaw))
        return Trajectory(self.stamps_ns, T)

    def records(self, start_ns=None, end_ns=None, kinds=()):
        if ImuSample not in kinds:
            yield from super().records(start_ns, end_ns, kinds)
            return
        for stamp_ns in range(start_ns, end_ns + 1, 10**7):
            # The sensor hangs upside down: y to the right, z down.
            force = np.array([0.0, -15.0 * self.turn_rate, -9.81])
            yield ImuSample(stamp_ns, np.array([0.0, 0, -self.turn_rate]), force)


def street_map(folder: Path) -> LocalMap:
    world = np.concatenate([ground(0.0), wall(20.0, half=2.0), wall(40.0)]).astype(np.float32)
    settings = MapConfig(see_through=False, neighbours=0, vehicle=0.0)
    builder = MapBuilder(TileFolder.create(folder, settings), settings)
    builder.add(PointCloud(world), np.eye(4), np.eye(4))
    builder.finish()
    return LocalMap(folder)


def street_samples(folder: Path, draws: int = 3, spacing: float = 3.0) -> SampleSet:
    drive = StreetWithCamera()
    make_samples(
        folder / 'samples', drive, drive.truth(), street_map(folder / 'map'), SMALL, STAGES[0],
        SamplesConfig(spacing=spacing, draws=draws),
    )  # fmt: skip
    return SampleSet(folder / 'samples')
