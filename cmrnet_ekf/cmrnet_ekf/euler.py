"""Convert between rotations and roll, pitch, yaw: R = Rz(yaw) Ry(pitch) Rx(roll), radians."""

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

Array = NDArray[np.float64]


def rotations(euler: ArrayLike) -> Array:
    """Return rotation matrices [... x 3 x 3] of roll pitch yaw [... x 3]."""
    angles = np.asarray(euler, np.float64)
    (sr, sp, sy), (cr, cp, cy) = (np.moveaxis(f(angles), -1, 0) for f in (np.sin, np.cos))
    rows = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def euler_angles(R: ArrayLike) -> Array:
    """Return roll pitch yaw [... x 3] of rotation matrices; pitch within +-pi/2."""
    m = np.asarray(R, np.float64)
    return np.stack(
        [
            np.arctan2(m[..., 2, 1], m[..., 2, 2]),
            np.arctan2(-m[..., 2, 0], np.hypot(m[..., 0, 0], m[..., 1, 0])),
            np.arctan2(m[..., 1, 0], m[..., 0, 0]),
        ],
        -1,
    )


def transforms(components: ArrayLike) -> Array:
    """Return transforms [... x 4 x 4] of components x y z roll pitch yaw [... x 6]."""
    c = np.asarray(components, np.float64)
    T = np.zeros((*c.shape[:-1], 4, 4))
    T[..., :3, :3] = rotations(c[..., 3:])
    T[..., :3, 3] = c[..., :3]
    T[..., 3, 3] = 1.0
    return T


def components(T: ArrayLike) -> Array:
    """Return x y z roll pitch yaw [... x 6] of transforms [... x 4 x 4]."""
    T = np.asarray(T, np.float64)
    return np.concatenate([T[..., :3, 3], euler_angles(T[..., :3, :3])], -1)


def wrapped(angle: Array) -> Array:
    """Return angles within -pi .. pi."""
    return np.asarray(np.mod(angle + np.pi, 2.0 * np.pi) - np.pi, np.float64)


def jacobian_to_body(components: ArrayLike) -> Array:
    """Return J [6 x 6]: a small change of the components moves the pose by `exp(J @ change)`.

    The pose is perturbed on the right, translation first (see `lcd_common.se3`).
    """
    c = np.asarray(components, np.float64)
    roll, pitch = c[3], c[4]
    sr, cr, sp, cp = np.sin(roll), np.cos(roll), np.sin(pitch), np.cos(pitch)
    J = np.zeros((6, 6))
    J[:3, :3] = rotations(c[3:]).T
    J[3:, 3:] = [[1.0, 0.0, -sp], [0.0, cr, sr * cp], [0.0, -sr, cr * cp]]
    return J


def euler_of_quaternion(quaternion: Tensor) -> Tensor:
    """Return roll pitch yaw [B x 3] of unit quaternions x y z w [B x 4]."""
    x, y, z, w = quaternion.unbind(-1)
    roll = torch.atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y))
    pitch = torch.asin((2.0 * (w * y - z * x)).clamp(-1.0, 1.0))
    yaw = torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return torch.stack([roll, pitch, yaw], -1)


def quaternion_of_euler(euler: Tensor) -> Tensor:
    """Return unit quaternions x y z w [B x 4] of roll pitch yaw [B x 3]."""
    (sr, sp, sy), (cr, cp, cy) = (f(0.5 * euler).unbind(-1) for f in (torch.sin, torch.cos))
    return torch.stack(
        [
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
            cr * cp * cy + sr * sp * sy,
        ],
        -1,
    )


def rotation_tensor(euler: Tensor) -> Tensor:
    """Return rotation matrices [B x 3 x 3] of roll pitch yaw [B x 3]."""
    (sr, sp, sy), (cr, cp, cy) = (f(euler).unbind(-1) for f in (torch.sin, torch.cos))
    rows = (
        (cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr),
        (sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr),
        (-sp, cp * sr, cp * cr),
    )
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def wrapped_tensor(angle: Tensor) -> Tensor:
    """Return angles within -pi .. pi; the gradient is that of the angle."""
    return angle - 2.0 * torch.pi * torch.round(angle / (2.0 * torch.pi))
