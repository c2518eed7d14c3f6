"""Hold a drive for tracking: frames as a network takes them, and how the vehicle moved."""

import json
from collections.abc import Callable
from dataclasses import dataclass
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
_FRAMES = 'frames.raw'  # one behind the other: their number is known at the end


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
    measured = _turn_rates(drive, places, stamps_ns)
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


def _turn_rates(
    drive: Drive, places: dict[str, se3.Array], stamps_ns: NDArray[np.int64]
) -> se3.Array | None:
    """Return the gyroscope's mean turn rates between stamps [F - 1]; None where it is silent."""
    times, rates = [], []
    first, last = int(stamps_ns[0]), int(stamps_ns[-1])
    for sample in drive.records(first, last, kinds=[ImuSample]):
        assert isinstance(sample, ImuSample)
        if sample.frame_id in places:
            times.append(sample.stamp_ns)
            rates.append((places[sample.frame_id][:3, :3] @ sample.angular_velocity)[2])
    if not times:
        return None
    which = np.searchsorted(stamps_ns, np.array(times), side='right') - 1
    counts = np.bincount(which, minlength=len(stamps_ns))[:-1]
    if not counts.all():
        return None
    return np.asarray(np.bincount(which, rates, len(stamps_ns))[:-1] / counts, np.float64)
