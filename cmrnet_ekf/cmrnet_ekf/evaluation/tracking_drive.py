"""Hold a drive for tracking: frames as a network takes them, and how the vehicle moved."""

import json
from collections.abc import Callable
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bags.records import CameraImage, CameraModel, Drive, ImuSample
from cmrnet_ekf.camera_localizer import framing_of
from cmrnet_ekf.networks.config import CmrnetConfig
from lcd_common import se3
from lcd_common.errors import DataError
from lcd_common.trajectory import Trajectory

_FACTS = 'facts.json'
_INERTIAL = ('imu_ns', 'turn_rates', 'forces', 'T_base_imu')
_FRAMES = 'frames.raw'  # one behind the other: their number is known at the end


@dataclass(frozen=True)
class InertialTrack:
    """What an inertial sensor felt along a drive, in its own axes.

    Attributes:
        stamps_ns: [N].
        turn_rates: [N x 3] rad/s.
        forces: [N x 3] m/s^2, +g up at rest.
        T_base_imu: where it sits.
    """

    stamps_ns: NDArray[np.int64]
    turn_rates: se3.Array
    forces: se3.Array
    T_base_imu: se3.Array


@dataclass(frozen=True)
class TrackingDrive:
    """F images with what moved the vehicle between them.

    Attributes:
        name: of the drive.
        stamps_ns: [F].
        T_map_base: [F x 4 x 4] the truth.
        frames: [F x H x W x 3] uint8, framed for a network.
        speeds_mps: [F] forward, mean since the image before; 0 for the first.
        turn_rates_radps: [F] about the vehicle's vertical axis, mean since the image before.
        turned_by: what measured the turns: imu or truth.
        camera: of the frames.
        T_base_camera: where its optical frame sits.
        images: which images these are; see `CmrnetConfig.images`.
        imu: None where the drive has none.
    """

    name: str
    stamps_ns: NDArray[np.int64]
    T_map_base: se3.Array
    frames: NDArray[np.uint8]
    speeds_mps: se3.Array
    turn_rates_radps: se3.Array
    turned_by: str
    camera: CameraModel
    T_base_camera: se3.Array
    images: tuple[float, ...]
    imu: InertialTrack | None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def length_m(self) -> float:
        """Path length, metres."""
        return Trajectory(self.stamps_ns, self.T_map_base).length_m

    @classmethod
    def load(cls, folder: Path) -> 'TrackingDrive':
        """Open what `record` wrote; frames stay on the disk.

        Raises:
            DataError: it is not there.
        """
        try:
            facts = json.loads((folder / _FACTS).read_text())
            shape = tuple(facts['frames'])
            frames = np.memmap(folder / _FRAMES, np.uint8, 'r', shape=shape)
            with np.load(folder / 'motion.npz', allow_pickle=False) as motion:
                arrays = {name: motion[name] for name in motion.files}
        except (OSError, ValueError, KeyError) as error:
            raise DataError(
                f'{folder}: no drive for tracking ({error}); remove it, it is made anew'
            ) from error
        height, width = frames.shape[1:3]
        K = np.array(facts['K'], np.float64)
        camera = CameraModel('camera', width, height, K, tuple(facts['distortion']))
        T_base_camera = np.array(facts['T_base_camera'], np.float64)
        return cls(
            facts['name'],
            arrays['stamps_ns'],
            arrays['T_map_base'],
            frames,
            arrays['speeds_mps'],
            arrays['turn_rates_radps'],
            facts['turned_by'],
            camera,
            T_base_camera,
            tuple(facts['images']),
            InertialTrack(*(arrays[name] for name in _INERTIAL)) if 'forces' in arrays else None,
        )


def record(
    folder: Path,
    drive: Drive,
    poses: Trajectory,
    network: CmrnetConfig,
    span_ns: tuple[int | None, int | None] = (None, None),
    progress: Callable[[], object] = lambda: None,
) -> TrackingDrive:
    """Keep the images of a drive as a network takes them, with motion, and open the folder.

    Turn rates are the gyroscope's where the drive has an inertial sensor, else the truth's. Speeds
    are the truth's: who tracks makes them as wrong as wheels are.

    Args:
        folder: new; one that is whole is opened.
        drive: with a camera.
        poses: of base_link in the map.
        network: says which images it takes.
        span_ns: the part of the drive, inclusive.
        progress: called after each image.

    Raises:
        DataError: there is no camera, no place of it, or fewer than two images have a pose.
    """
    if (folder / _FACTS).is_file():
        return TrackingDrive.load(folder)
    places = {m.child: m.T_parent_child for m in drive.mountings}
    if drive.camera is None or drive.camera.frame_id not in places:
        raise DataError(f'{drive.path}: has no camera whose place is known')
    framing = framing_of(drive.camera, network)
    folder.mkdir(parents=True, exist_ok=True)
    stamps, poses_at = [], []
    with (folder / _FRAMES).open('wb') as file:
        for image in drive.records(*span_ns, kinds=[CameraImage]):
            assert isinstance(image, CameraImage)
            T_map_base = poses.at(image.stamp_ns)
            if T_map_base is None:
                continue
            stamps.append(image.stamp_ns)
            poses_at.append(T_map_base)
            file.write(framing.image(image.pixels).tobytes())
            progress()
    if len(stamps) < 2:
        raise DataError(f'{drive.path}: fewer than two images have a pose; are stamps the same?')
    T, stamps_ns = np.array(poses_at), np.array(stamps, np.int64)
    dt = np.diff(stamps_ns) * 1e-9
    T_step = se3.inverse(T[:-1]) @ T[1:]
    turned = np.array([se3.so3_log(one[:3, :3])[2] for one in T_step])
    rates, turned_by = turned / dt, 'truth'
    imu = inertial_track(drive, int(stamps_ns[0]), int(stamps_ns[-1]))
    measured = None if imu is None else _turn_rates(imu, stamps_ns)
    if measured is not None:
        rates, turned_by = measured, 'imu'
    # The way along the arc; the chord is a little shorter.
    chord, half = np.linalg.norm(T_step[:, :2, 3], axis=1) * np.sign(T_step[:, 0, 3]), turned / 2
    speeds = chord / np.sinc(half / np.pi) / dt
    np.savez(
        folder / 'motion.npz',
        allow_pickle=False,
        stamps_ns=stamps_ns,
        T_map_base=T,
        speeds_mps=np.r_[0.0, speeds],
        turn_rates_radps=np.r_[0.0, rates],
        **({} if imu is None else dict(zip(_INERTIAL, astuple(imu), strict=True))),
    )
    facts = {
        'name': drive.name,
        'turned_by': turned_by,
        'frames': [len(stamps), framing.camera.height, framing.camera.width, 3],
        'K': framing.camera.K.tolist(),
        'distortion': list(framing.camera.distortion),
        'T_base_camera': places[drive.camera.frame_id].tolist(),
        'images': network.images,
    }
    (folder / _FACTS).write_text(json.dumps(facts, indent=1) + '\n')
    return TrackingDrive.load(folder)


def inertial_track(drive: Drive, start_ns: int, end_ns: int) -> InertialTrack | None:
    """Return what the drive's inertial sensor felt in a time; None where nothing says."""
    places = {m.child: m.T_parent_child for m in drive.mountings}
    samples: list[ImuSample] = []
    for sample in drive.records(start_ns, end_ns, kinds=[ImuSample]):
        assert isinstance(sample, ImuSample)
        # Of several sensors the first to speak.
        if sample.frame_id in places and sample.frame_id == (samples or [sample])[0].frame_id:
            samples.append(sample)
    if not samples:
        return None
    return InertialTrack(
        np.array([sample.stamp_ns for sample in samples], np.int64),
        np.array([sample.angular_velocity for sample in samples]),
        np.array([sample.linear_acceleration for sample in samples]),
        places[samples[0].frame_id],
    )


def _turn_rates(imu: InertialTrack, stamps_ns: NDArray[np.int64]) -> se3.Array | None:
    """Return the gyroscope's mean turn rates between stamps [F - 1]; None where it is silent."""
    rates = (imu.turn_rates @ imu.T_base_imu[:3, :3].T)[:, 2]
    which = np.searchsorted(stamps_ns, imu.stamps_ns, side='right') - 1
    counts = np.bincount(which, minlength=len(stamps_ns))[:-1]
    if not counts.all():
        return None
    return np.asarray(np.bincount(which, rates, len(stamps_ns))[:-1] / counts, np.float64)
