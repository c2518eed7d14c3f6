"""List a folder of files named by a number, and read the files that data sets share."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from bags.skips import Skips, UnreadableError
from lcd_common.cloud import PointCloud

_POINT_BYTES = 16


def numbered_files(folder: Path, suffixes: tuple[str, ...], skips: Skips) -> dict[int, Path]:
    """Return the files of a folder by the number that is their name, in its order.

    A file of such a suffix whose name is no number is counted and left out.
    """
    found: dict[int, Path] = {}
    if not folder.is_dir():
        return found
    for path in folder.iterdir():
        if path.suffix.lower() not in suffixes or path.name.startswith('.'):
            continue
        if path.stem.isdecimal():
            found[int(path.stem)] = path
        else:
            skips.add('file name is not a number', path, f'{path}: the name must be a number')
    return dict(sorted(found.items()))


def read_float32_cloud(path: Path) -> PointCloud:
    """Read a .bin file of float32 x y z reflectance rows (KITTI, KITTI-360, MulRan).

    Raises:
        UnreadableError: the file is gone, or its size is not a multiple of 16 bytes. A file cut
            off in the middle also lost a part of the sweep: it is left out, not read half.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnreadableError('unreadable scan file', f'{path}: {error.strerror}') from None
    if len(data) % _POINT_BYTES:
        raise UnreadableError(
            'scan file of odd size',
            f'{path}: a scan has 16 bytes a point, got {len(data)} bytes; copy the file again',
        )
    points = np.frombuffer(data, '<f4').reshape(-1, 4)
    return PointCloud(np.ascontiguousarray(points[:, :3]), points[:, 3].copy())


def read_labels(path: Path, points: int) -> NDArray[np.uint16]:
    """Read SemanticKITTI's labels [N] of a sweep of so many points.

    Raises:
        UnreadableError: the file is gone, or does not have 4 bytes a point.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UnreadableError('unreadable label file', f'{path}: {error.strerror}') from None
    if len(data) != 4 * points:
        raise UnreadableError(
            'labels that do not fit their scan',
            f'{path}: {len(data)} bytes for {points} points; labels have 4 bytes a point: '
            'give those of the same sweeps',
        )
    return (np.frombuffer(data, '<u4') & 0xFFFF).astype(np.uint16)


def read_text_cloud(path: Path) -> PointCloud:
    """Read a text file of `x y z reflectance` rows (KITTI's unsynchronised sweeps).

    Raises:
        UnreadableError: a row has another count of numbers, or the file is gone.
    """
    try:
        rows = np.loadtxt(path, np.float32, ndmin=2)
    except OSError as error:
        raise UnreadableError('unreadable scan file', f'{path}: {error.strerror}') from None
    except ValueError as error:
        raise UnreadableError('unreadable scan file', f'{path}: {error}') from None
    if rows.size and rows.shape[1] != 4:
        message = f'{path}: a row has 4 numbers, got {rows.shape[1]}'
        raise UnreadableError('unreadable scan file', message)
    rows = rows.reshape(-1, 4)
    return PointCloud(np.ascontiguousarray(rows[:, :3]), rows[:, 3].copy())


def read_image(path: Path) -> NDArray[np.uint8]:
    """Read an image file as grey [H x W] or RGB [H x W x 3].

    Raises:
        UnreadableError: it is no image, or it is cut off.
    """
    try:
        with Image.open(path) as image:
            pixels = image if image.mode in ('L', 'RGB') else image.convert('RGB')
            return np.asarray(pixels, dtype=np.uint8)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError) as error:
        raise UnreadableError(
            'unreadable image', f'{path}: not a readable image: {error}'
        ) from None


def image_size(paths: list[Path]) -> tuple[int, int] | None:
    """Return width and height of the first image whose header can be read."""
    for path in paths:
        try:
            with Image.open(path) as image:
                return image.size
        except (OSError, UnidentifiedImageError, SyntaxError):
            continue
    return None
