"""Let clouds pass through Fast DDS in one piece."""

import os
import shutil
from pathlib import Path

PROFILE = Path(__file__).resolve().parents[1] / 'fast_dds.xml'
_CHOSEN = (
    'FASTRTPS_DEFAULT_PROFILES_FILE',
    'FASTDDS_DEFAULT_PROFILES_FILE',
    'FASTDDS_BUILTIN_TRANSPORTS',
)
_SHARED_MEMORY = Path('/dev/shm')
_ENOUGH_BYTES = 256 << 20  # for a handful of nodes; containers often have 64 MB
_IN_FOLDER = 'DEFAULT_FASTRTPS_PROFILES.xml'  # read by Fast DDS where it lies


def carry_large_messages() -> bool:
    """Give this process a shared-memory segment that holds several sweeps; return whether it did.

    It is to be called before rclpy.init. What the user has chosen stays: a profile, transports, or
    another middleware than Fast DDS. Where shared memory is short nothing changes either: Fast DDS
    would do without it altogether.
    """
    middleware = os.environ.get('RMW_IMPLEMENTATION', '')
    if middleware and 'fastrtps' not in middleware:
        return False
    if any(os.environ.get(name) for name in _CHOSEN) or Path(_IN_FOLDER).is_file():
        return False
    if not _SHARED_MEMORY.is_dir() or shutil.disk_usage(_SHARED_MEMORY).free < _ENOUGH_BYTES:
        return False
    os.environ[_CHOSEN[0]] = str(PROFILE)
    return True
