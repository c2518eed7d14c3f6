"""Replace the folder of a map as a whole, or not at all."""

import fcntl
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from lcd_common.errors import MapError

# What a map's folder may hold. A folder with anything else is somebody's, and is never removed.
MAP_FILES = re.compile(
    r'meta\.json|graph\.npz|descriptors\.npz|clouds|clouds/\d+\.npz'
    r'|trajectory\.tum|poses_kitti\.txt|graph\.g2o'
)


@contextmanager
def replaced(target: Path, own: re.Pattern[str] = MAP_FILES) -> Iterator[Path]:
    """Give a new folder to write into; when the block ends well it takes the target's place.

    A kill at any moment leaves the old map or the new one: at the target, or, between the two
    renames, beside it, from where `settle` brings it back. An error leaves the old one. `own` says
    which files may be replaced, by their names in the folder.

    Raises:
        MapError: the target holds something that is no map, or another process saves there.
        OSError: the disk does not take it.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    saving, previous = _beside(target, 'saving'), _beside(target, 'previous')
    settle(target)
    _refuse_foreign(target, own)
    _remove(previous, own)
    if saving.exists():  # of a save that was killed, or of one that goes on
        with _locked(saving):
            _remove(saving, own)
    saving.mkdir()
    with _locked(saving):
        try:
            yield saving
            _flush(saving)
        except BaseException:
            _remove(saving, own)
            raise
        if target.exists():
            os.rename(target, previous)
        os.rename(saving, target)
        _flush_folder(target.parent)
    _remove(previous, own)


def settle(target: Path) -> None:
    """Bring the old map back when a save was killed between its two renames."""
    previous = _beside(target, 'previous')
    if previous.is_dir() and not target.exists():
        os.rename(previous, target)
        _flush_folder(target.parent)


def _beside(target: Path, what: str) -> Path:
    return target.parent / f'.{target.name}.{what}'


def _foreign(folder: Path, own: re.Pattern[str]) -> str | None:
    for path in sorted(folder.rglob('*')):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not own.fullmatch(name):
            return name
    return None


def _refuse_foreign(target: Path, own: re.Pattern[str]) -> None:
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise MapError(f'{target}: is not a folder; choose another path for the map')
    if not target.exists():
        return
    foreign = _foreign(target, own)
    if foreign is not None:
        raise MapError(
            f'{target}: holds {foreign}, which is no part of a map; nothing was removed, '
            'choose another folder'
        )
    if any(target.iterdir()) and not (target / 'meta.json').is_file():
        raise MapError(f'{target}: is not empty and not a map; choose another folder')


def _remove(folder: Path, own: re.Pattern[str]) -> None:
    if not folder.exists():
        return
    foreign = _foreign(folder, own)
    if foreign is not None:
        raise MapError(f'{folder}: holds {foreign}, which is no part of a map; move it away')
    shutil.rmtree(folder)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder against other processes; a killed one lets go by itself."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise MapError(
                f'{folder}: another process is saving this map; wait, or choose another folder'
            ) from None
        yield
    finally:
        os.close(descriptor)


def _flush(folder: Path) -> None:
    for path in sorted(folder.rglob('*'), reverse=True):
        if path.is_dir():
            _flush_folder(path)
        else:
            with path.open('rb') as file:
                os.fsync(file.fileno())
    _flush_folder(folder)


def _flush_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
