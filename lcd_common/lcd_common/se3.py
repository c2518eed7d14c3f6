"""Compute with rigid transforms.

Notation, everywhere in the suite: `T_a_b` is a 4x4 float64 matrix that takes points from frame b to
frame a, `p_a = T_a_b * p_b`. Tangent vectors are translation first, `xi = [rho, phi]`, metres and
radians, and perturb on the right: `T_true = T_estimate * exp(xi)`. Covariances of a transform are
6x6 over that xi ("body axes" of b). ROS uses the axes of the parent frame a instead, and GTSAM puts
rotation first; the conversions below are the only places that know.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
_SMALL_ANGLE = 1e-8
_ROTATION_FIRST = np.array([3, 4, 5, 0, 1, 2])


def hat(v: ArrayLike) -> Array:
    """Return the skew-symmetric 3x3 matrix with `hat(v) @ w == cross(v, w)`."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def so3_exp(phi: ArrayLike) -> Array:
    """Return the rotation matrix of a rotation vector (radians)."""
    phi = np.asarray(phi, dtype=np.float64)
    angle = float(np.linalg.norm(phi))
    k = hat(phi)
    if angle < _SMALL_ANGLE:
        return np.eye(3) + k + 0.5 * k @ k
    return np.eye(3) + np.sin(angle) / angle * k + (1.0 - np.cos(angle)) / angle**2 * k @ k


def so3_log(R: Array) -> Array:
    """Return the rotation vector (radians, norm at most pi) of a 3x3 rotation matrix."""
    x, y, z, w = quaternion_from_rotation(R)
    v = np.array([x, y, z])
    n = float(np.linalg.norm(v))
    if n < _SMALL_ANGLE:
        return 2.0 * v
    return 2.0 * np.arctan2(n, w) / n * v


def _left_jacobian(phi: Array) -> Array:
    angle = float(np.linalg.norm(phi))
    k = hat(phi)
    if angle < 1e-5:
        return np.eye(3) + 0.5 * k + k @ k / 6.0
    a = (1.0 - np.cos(angle)) / angle**2
    b = (angle - np.sin(angle)) / angle**3
    return np.eye(3) + a * k + b * k @ k


def exp(xi: ArrayLike) -> Array:
    """Return the 4x4 transform of a twist `[rho, phi]`."""
    xi = np.asarray(xi, dtype=np.float64)
    T = np.eye(4)
    T[:3, :3] = so3_exp(xi[3:])
    T[:3, 3] = _left_jacobian(xi[3:]) @ xi[:3]
    return T


def log(T: Array) -> Array:
    """Return the twist `[rho, phi]` of a 4x4 transform."""
    phi = so3_log(T[:3, :3])
    return np.concatenate([np.linalg.solve(_left_jacobian(phi), T[:3, 3]), phi])


def inverse(T: Array) -> Array:
    """Invert transforms [... x 4 x 4]."""
    T = np.asarray(T, dtype=np.float64)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    out = np.zeros_like(T)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -np.einsum('...ij,...j->...i', R_t, T[..., :3, 3])
    out[..., 3, 3] = 1.0
    return out


def adjoint(T: Array) -> Array:
    """Return the 6x6 adjoint: `T * exp(xi) * T^-1 == exp(adjoint(T) @ xi)`."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[:3, 3:] = hat(t) @ R
    return out


def transform_points(T_a_b: Array, p_b: NDArray[np.floating]) -> NDArray[np.floating]:
    """Take points [N x 3] from frame b to frame a, in the dtype that they come in."""
    R = T_a_b[:3, :3].astype(p_b.dtype)
    return p_b @ R.T + T_a_b[:3, 3].astype(p_b.dtype)


def from_rotation_translation(R: ArrayLike, t: ArrayLike) -> Array:
    """Assemble a 4x4 transform."""
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = t
    return T


def from_xyz_quaternion(xyz: ArrayLike, quaternion_xyzw: ArrayLike) -> Array:
    """Assemble a 4x4 transform; the quaternion is normalised, a zero one raises ValueError."""
    x, y, z, w = np.asarray(quaternion_xyzw, dtype=np.float64)
    n = x * x + y * y + z * z + w * w
    if not np.isfinite(n) or n < 1e-12:
        raise ValueError(f'quaternion must have a length, got x={x} y={y} z={z} w={w}')
    s = 2.0 / n
    R = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
            [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
            [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
        ]
    )
    return from_rotation_translation(R, xyz)


def quaternion_from_rotation(R: Array) -> Array:
    """Return the unit quaternion x y z w, w >= 0, of a 3x3 rotation matrix."""
    # Shepperd's method: divide by the largest of the four, so that nothing cancels.
    candidates = np.array([R[0, 0], R[1, 1], R[2, 2], np.trace(R)])
    i = int(np.argmax(candidates))
    q = np.empty(4)
    if i == 3:
        q[:] = [R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + candidates[3]]
    else:
        j, k = (i + 1) % 3, (i + 2) % 3
        q[i] = 1.0 + 2.0 * R[i, i] - candidates[3]
        q[j] = R[j, i] + R[i, j]
        q[k] = R[k, i] + R[i, k]
        q[3] = R[k, j] - R[j, k]
    q /= np.linalg.norm(q)
    return q if q[3] >= 0 else -q


def yaw(T: Array) -> float:
    """Return the heading of a transform's x axis in the parent's xy plane, radians."""
    return float(np.arctan2(T[1, 0], T[0, 0]))


def rotation_z(angle: float) -> Array:
    """Return the 4x4 transform that turns by `angle` radians about z."""
    return exp([0, 0, 0, 0, 0, angle])


def rotation_angle(T: Array) -> float:
    """Return the angle of a transform's rotation, radians in 0..pi."""
    return float(np.linalg.norm(so3_log(T[:3, :3])))


def distance(T_a_b: Array, T_a_c: Array) -> tuple[float, float]:
    """Return metres and radians between two transforms."""
    difference = inverse(T_a_b) @ T_a_c
    return float(np.linalg.norm(difference[:3, 3])), rotation_angle(difference)


def interpolate(T_a_b: Array, T_a_c: Array, share: float) -> Array:
    """Return the transform at `share` (0..1) of the way from b to c, along the screw motion."""
    return T_a_b @ exp(share * log(inverse(T_a_b) @ T_a_c))


def compose_covariance(covariance_ab: Array, T_b_c: Array, covariance_bc: Array) -> Array:
    """Return the body-axes covariance of `T_a_b * T_b_c` from independent errors of both."""
    A = adjoint(inverse(T_b_c))
    return A @ covariance_ab @ A.T + covariance_bc


def relative_covariance(covariance_oa: Array, T_a_b: Array, covariance_ob: Array) -> Array | None:
    """Return the body-axes covariance of `T_a_b` that `compose_covariance` added between a and b.

    None when the difference is not positive definite: then the two were not accumulated along the
    path (a constant, zeros, a filter that was corrected in between) and say nothing about `T_a_b`.
    """
    A = adjoint(inverse(T_a_b))
    added = covariance_ob - A @ covariance_oa @ A.T
    added = 0.5 * (added + added.T)
    return added if is_covariance(added) else None


def invert_covariance(T_a_b: Array, covariance_ab: Array) -> Array:
    """Return the body-axes covariance of `T_b_a` from that of `T_a_b`."""
    A = adjoint(T_a_b)
    return A @ covariance_ab @ A.T


def ros_covariance(T_a_b: Array, covariance_body: Array) -> Array:
    """Turn a body-axes covariance into ROS's: order x y z rotX rotY rotZ about the axes of a."""
    R = np.kron(np.eye(2), T_a_b[:3, :3])
    return R @ covariance_body @ R.T


def covariance_from_ros(T_a_b: Array, covariance_ros: Array) -> Array:
    """Turn ROS's covariance (axes of a) into the body-axes one."""
    R = np.kron(np.eye(2), T_a_b[:3, :3])
    return R.T @ covariance_ros @ R


def gtsam_covariance(covariance_body: Array) -> Array:
    """Reorder a body-axes covariance to GTSAM's Pose3 order: rotation first."""
    return covariance_body[np.ix_(_ROTATION_FIRST, _ROTATION_FIRST)]


def covariance_from_gtsam(covariance_gtsam: Array) -> Array:
    """Reorder GTSAM's rotation-first Pose3 covariance to translation first."""
    return covariance_gtsam[np.ix_(_ROTATION_FIRST, _ROTATION_FIRST)]


def is_covariance(covariance: Array) -> bool:
    """Tell whether a matrix is finite, symmetric and positive definite."""
    if not np.all(np.isfinite(covariance)):
        return False
    scale = float(np.max(np.abs(covariance)))
    if not np.allclose(covariance, covariance.T, rtol=0, atol=1e-9 * max(scale, 1e-12)):
        return False
    return bool(np.all(np.linalg.eigvalsh(covariance) > 0.0))
