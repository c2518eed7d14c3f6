"""Write a cloud as PLY or PCD, the binary little-endian kind that viewers open."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lcd_common.cloud import PointCloud


def write_ply(cloud: PointCloud, path: Path) -> None:
    """Write x y z, and intensity where known, float32."""
    points = _structured(cloud)
    properties = ''.join(f'property float {name}\n' for name in points.dtype.names or ())
    header = (
        f'ply\nformat binary_little_endian 1.0\ncomment frame map, metres\n'
        f'element vertex {len(points)}\n{properties}end_header\n'
    )
    with path.open('wb') as file:
        file.write(header.encode())
        file.write(points.tobytes())


def write_pcd(cloud: PointCloud, path: Path) -> None:
    """Write x y z, and intensity where known, float32 (PCD 0.7)."""
    points = _structured(cloud)
    names = points.dtype.names or ()
    header = (
        '# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\n'
        f'FIELDS {" ".join(names)}\nSIZE {" ".join("4" for _ in names)}\n'
        f'TYPE {" ".join("F" for _ in names)}\nCOUNT {" ".join("1" for _ in names)}\n'
        f'WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\n'
        'DATA binary\n'
    )
    with path.open('wb') as file:
        file.write(header.encode())
        file.write(points.tobytes())


def _structured(cloud: PointCloud) -> NDArray[np.void]:
    columns = {'x': cloud.xyz[:, 0], 'y': cloud.xyz[:, 1], 'z': cloud.xyz[:, 2]}
    if cloud.intensity is not None:
        columns['intensity'] = cloud.intensity
    points = np.empty(len(cloud), dtype=[(name, '<f4') for name in columns])
    for name, values in columns.items():
        points[name] = values
    return points
