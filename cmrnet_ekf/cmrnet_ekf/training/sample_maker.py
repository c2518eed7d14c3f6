"""Make samples from a drive with a camera and a map."""

import json
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.lib.format import open_memmap
from numpy.typing import NDArray

from bags.records import CameraImage, Drive
from cmrnet_ekf.camera_localizer import framing_of, imager_of
from cmrnet_ekf.mapping.local_map import LocalMap, near_origin
from cmrnet_ekf.networks.config import CmrnetConfig
from cmrnet_ekf.pose_sampling import T_OPTICAL_BODY, NoiseRange
from cmrnet_ekf.training.sample_set import FORMAT, FULL_SCALE, VERSION
from lcd_common import se3
from lcd_common.errors import ConfigError, DataError
from lcd_common.settings import config, setting
from lcd_common.trajectory import Trajectory


@config
class SamplesConfig:
    """Which frames are taken, and how many guesses for each."""

    spacing: float = setting(1.0, 'way between frames', unit='m', low=0.0)
    turn: float = setting(
        0.0,
        'turn after which a frame is taken, however short the way: bends are rare, and a vehicle '
        'that loses itself does so there; 0: way alone',
        unit='deg',
        low=0.0,
    )
    draws: int = setting(8, 'guesses for each frame', low=1)
    least_fill: float = setting(
        0.02, 'share of pixels that must show the map; frames with less are left out', low=0, high=1
    )
    seed: int = setting(0, 'of the guesses', low=0)


def make_samples(
    out: Path,
    drive: Drive,
    poses: Trajectory,
    local_map: LocalMap,
    network: CmrnetConfig,
    noise: NoiseRange,
    settings: SamplesConfig,
    progress: Callable[[], None] = lambda: None,
    span_ns: tuple[int | None, int | None] = (None, None),
) -> int:
    """Write a set of samples; returns how many there are.

    Args:
        out: new folder.
        drive: with a camera.
        poses: of base_link in the map.
        local_map: of where the drive goes.
        network: says which images it takes.
        noise: how far guesses are off.
        settings: which frames.
        progress: called after each frame.
        span_ns: the part of the drive, inclusive.

    Raises:
        ConfigError: the folder is there.
        DataError: the drive has no camera, or no frame shows the map.
    """
    if (out / 'facts.json').exists():
        raise ConfigError(f'{out}: samples are there already; remove them or choose another folder')
    if drive.camera is None:
        raise DataError(f'{drive.path}: has no camera; bags info shows what there is')
    places = {m.child: m.T_parent_child for m in drive.mountings}
    if drive.camera.frame_id not in places:
        raise DataError(f'{drive.path}: nothing says where {drive.camera.frame_id} sits')
    T_base_body = places[drive.camera.frame_id] @ T_OPTICAL_BODY
    framing = framing_of(drive.camera, network)
    imager = imager_of(framing.camera, network)
    rng = np.random.default_rng([settings.seed, zlib.crc32(drive.name.encode())])
    stamps = _spaced(drive, poses, settings, span_ns)
    out.mkdir(parents=True, exist_ok=True)
    shape = network.height, network.width
    frames = open_memmap(out / 'frames.part.npy', 'w+', np.uint8, (len(stamps), *shape, 3))
    count = len(stamps) * settings.draws
    lidar = open_memmap(out / 'lidar.part.npy', 'w+', np.uint16, (count, *shape))
    guesses, frame_of, kept = np.empty((count, 4, 4)), np.empty(count, np.int64), 0
    places_of = np.empty((len(stamps), 4, 4))
    for record, T_map_base in _frames(drive, poses, stamps):
        T_camera_guess = noise.draw(rng, settings.draws)
        points, origin = local_map.around(T_map_base)
        T_near_body = near_origin(T_map_base, origin) @ T_base_body
        images = imager.images(
            [points] * settings.draws,
            [T_OPTICAL_BODY @ se3.inverse(T_near_body @ T) for T in T_camera_guess],
        ).numpy()
        progress()
        if (images > 0).mean() < settings.least_fill:
            continue
        frames[kept] = framing.image(record.pixels)
        rows = slice(kept * settings.draws, (kept + 1) * settings.draws)
        lidar[rows] = np.rint(np.minimum(images / network.max_depth, 1.0) * FULL_SCALE)
        guesses[rows], frame_of[rows] = T_camera_guess, kept
        places_of[kept] = T_map_base @ T_base_body
        kept += 1
    if not kept:
        raise DataError(f'{out}: no frame of {drive.path} shows the map; do poses and map agree?')
    used = kept * settings.draws
    _finish(out / 'frames.part.npy', frames, kept)
    _finish(out / 'lidar.part.npy', lidar, used)
    np.save(out / 'guesses.npy', guesses[:used])
    np.save(out / 'frame_of.npy', frame_of[:used])
    np.save(out / 'places.npy', places_of[:kept])
    facts = {
        'format': FORMAT,
        'version': VERSION,
        'drive': drive.name,
        'images': network.images,
        'max_depth': network.max_depth,
        'noise_m': noise.translation_m,
        'noise_deg': float(np.rad2deg(noise.rotation_rad)),
        'frames': kept,
        'samples': used,
        'map': str(local_map.path.resolve()),
        'camera': {'K': framing.camera.K.tolist(), 'distortion': list(framing.camera.distortion)},
    }
    (out / 'facts.json').write_text(json.dumps(facts, indent=1) + '\n')
    return used


def _spaced(
    drive: Drive,
    poses: Trajectory,
    settings: SamplesConfig,
    span_ns: tuple[int | None, int | None],
) -> NDArray[np.int64]:
    """Return stamps of frames, spaced by the way and the turns of the poses."""
    start, end = span_ns
    way = np.concatenate(
        [[0.0], np.cumsum(np.linalg.norm(np.diff(poses.positions, axis=0), axis=1))]
    )
    chosen, last = [], -1
    for k, stamp_ns in enumerate(poses.stamps_ns.tolist()):
        if (start is not None and stamp_ns < start) or (end is not None and stamp_ns > end):
            continue
        due = last < 0 or way[k] - way[last] >= settings.spacing
        if not due and settings.turn:
            _, radians = se3.distance(poses.T_world_body[last], poses.T_world_body[k])
            due = np.rad2deg(radians) >= settings.turn
        if due:
            chosen.append(stamp_ns)
            last = k
    if not chosen:
        raise DataError(f'{drive.path}: no pose in the part that was asked for')
    return np.array(chosen, np.int64)


def _frames(
    drive: Drive, poses: Trajectory, stamps: NDArray[np.int64]
) -> Iterator[tuple[CameraImage, se3.Array]]:
    """Yield the image nearest to each stamp (within 60 ms) with its pose."""
    for stamp_ns in stamps.tolist():
        near = drive.records(stamp_ns - 60_000_000, stamp_ns + 60_000_000, [CameraImage])
        found = _nearest(near, stamp_ns)
        T_map_base = None if found is None else poses.at(found.stamp_ns)
        if found is not None and T_map_base is not None:
            yield found, T_map_base


def _nearest(records: Iterator[object], stamp_ns: int) -> CameraImage | None:
    best = None
    for record in records:
        assert isinstance(record, CameraImage)
        if best is None or abs(record.stamp_ns - stamp_ns) < abs(best.stamp_ns - stamp_ns):
            best = record
        if best.stamp_ns >= stamp_ns:
            break
    return best


def _finish(part: Path, array: NDArray[np.generic], count: int) -> None:
    """Cut an array to what is used, and give it its name."""
    whole = part.with_name(part.name.replace('.part', ''))
    if count == len(array):
        array.flush()  # type: ignore[attr-defined]
        part.replace(whole)
        return
    np.save(whole, array[:count])
    part.unlink()
