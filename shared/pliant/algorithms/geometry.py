"""Rotations, rigid motions and alignments.

``T_a_b`` maps points of frame b to frame a.  On the wire and in files a pose is seven numbers,
(x, y, z, qx, qy, qz, qw); inside, a (4, 4) matrix.
"""

import numpy as np

from pliant.algorithms.arrays import F64


def hat(vectors: F64) -> F64:
    """(..., 3) vectors to (..., 3, 3) skew matrices: ``hat(a) @ b == cross(a, b)``."""
    out = np.zeros((*vectors.shape[:-1], 3, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -z, y, -x
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = z, -y, x
    return out


def lengths(vectors: F64) -> F64:
    """(N,) of (N, 3) vectors: the bytes of ``np.linalg.norm`` in less than half its time."""
    x, y, z = vectors.T
    return np.sqrt(x * x + y * y + z * z)


def so3_exp(rotation_vectors: F64) -> F64:
    """(..., 3) rotation vectors in radians to (..., 3, 3) rotation matrices (Rodrigues)."""
    angle = np.linalg.norm(rotation_vectors, axis=-1)[..., None, None]
    W = hat(rotation_vectors)
    small = angle < 1e-6
    safe = np.where(small, 1.0, angle)
    a = np.where(small, 1.0 - angle**2 / 6.0, np.sin(safe) / safe)
    b = np.where(small, 0.5 - angle**2 / 24.0, (1.0 - np.cos(safe)) / safe**2)
    return np.eye(3) + a * W + b * (W @ W)


def so3_log(R: F64) -> F64:
    """(..., 3, 3) rotation matrices to (..., 3) rotation vectors with angle in [0, pi]."""
    quat_xyzw = quat_from_rotation(R)
    vector, w = quat_xyzw[..., :3], quat_xyzw[..., 3]
    norm = np.linalg.norm(vector, axis=-1)
    angle = 2.0 * np.arctan2(norm, w)
    scale = np.where(norm < 1e-12, 2.0, angle / np.where(norm < 1e-12, 1.0, norm))
    return vector * scale[..., None]


def _products_of_quaternion() -> F64:
    """(3, 3, 4, 4) by which a rotation becomes ``4 q q^T``, less the identity."""
    Q = np.zeros((3, 3, 4, 4))
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        for of in range(4):
            Q[i, i, of, of] = 1.0 if of in (i, 3) else -1.0
        Q[i, j, i, j] = Q[i, j, j, i] = Q[j, i, i, j] = Q[j, i, j, i] = 1.0
        Q[k, j, i, 3] = Q[k, j, 3, i] = 1.0
        Q[j, k, i, 3] = Q[j, k, 3, i] = -1.0
    return Q


_PRODUCTS = _products_of_quaternion().reshape(9, 16)


def quat_from_rotation(R: F64) -> F64:
    """(..., 3, 3) rotations to (..., 4) unit quaternions (x, y, z, w) with w >= 0."""
    m = np.asarray(R, np.float64)
    # Each row is a multiple of q, exact where its own component is large (Shepperd).
    candidates = (m.reshape(-1, 9) @ _PRODUCTS).reshape(-1, 4, 4) + np.eye(4)
    best = np.argmax(np.diagonal(candidates, axis1=1, axis2=2), axis=1)
    quat = candidates[np.arange(len(best)), best].reshape(*m.shape[:-2], 4)
    quat = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return np.where(quat[..., 3:4] < 0.0, -quat, quat)


def rotation_from_quat(quat_xyzw: F64) -> F64:
    """(..., 4) quaternions (x, y, z, w), normalised here, to (..., 3, 3) rotations."""
    q = np.asarray(quat_xyzw, np.float64)
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def pose_to_matrix(pose: F64) -> F64:
    """(..., 7) poses to (..., 4, 4) matrices."""
    pose = np.asarray(pose, np.float64)
    T = np.zeros((*pose.shape[:-1], 4, 4))
    T[..., :3, :3] = rotation_from_quat(pose[..., 3:])
    T[..., :3, 3] = pose[..., :3]
    T[..., 3, 3] = 1.0
    return T


def matrix_to_pose(T: F64) -> F64:
    """(..., 4, 4) matrices to (..., 7) poses."""
    return np.concatenate([T[..., :3, 3], quat_from_rotation(T[..., :3, :3])], axis=-1)


def inverse(T: F64) -> F64:
    """Invert (..., 4, 4) rigid motions."""
    out = np.zeros(T.shape)
    R_t = T[..., :3, :3].swapaxes(-1, -2)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(R_t @ T[..., :3, 3:4])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def transform(T: F64, points: F64) -> F64:
    """Apply one (4, 4) motion to (N, 3) points."""
    return points @ T[:3, :3].T + T[:3, 3]


def transform_each(T: F64, points: F64) -> F64:
    """Apply to each of (N, 3) points a motion, or a similarity, of its own (N, 4, 4)."""
    return (T[:, :3, :3] @ points[:, :, None])[:, :, 0] + T[:, :3, 3]


def similarity_to_matrix(similarity: F64) -> F64:
    """(..., 8) poses with a scale to (..., 4, 4) matrices of ``X -> scale R X + t``."""
    S = pose_to_matrix(similarity[..., :7])
    S[..., :3, :3] *= similarity[..., 7, None, None]
    return S


def matrix_to_similarity(S: F64) -> F64:
    """(..., 4, 4) matrices of ``X -> scale R X + t`` to (..., 8) poses with a scale."""
    scales = np.cbrt(np.linalg.det(S[..., :3, :3]))
    turned = S.copy()
    turned[..., :3, :3] /= scales[..., None, None]
    return np.concatenate([matrix_to_pose(turned), scales[..., None]], axis=-1)


def move_by_similarity(S: F64, T_world_camera: F64) -> F64:
    """Poses (..., 4, 4) after the world has moved by similarities (..., 4, 4)."""
    moved = S @ T_world_camera
    moved[..., :3, :3] /= np.cbrt(np.linalg.det(S[..., :3, :3]))[..., None, None]
    return moved


def align_umeyama(source: F64, target: F64, *, with_scale: bool) -> tuple[float, F64, F64]:
    """Least squares similarity (Umeyama 1991): ``target ~ scale * R @ source + t``.

    source, target: (N, 3), N >= 3.  Returns (scale, R (3, 3), t (3,)).  Raises ValueError when
    fewer than three points are given or the source has no extent.
    """
    if len(source) < 3:
        raise ValueError(f"alignment needs at least 3 poses, got {len(source)}")
    mean_source, mean_target = source.mean(axis=0), target.mean(axis=0)
    centred = source - mean_source
    variance = float((centred**2).sum() / len(source))
    if variance <= 0.0:
        raise ValueError("alignment needs a trajectory with extent: all positions are the same")
    U, D, Vt = np.linalg.svd((target - mean_target).T @ centred / len(source))
    S = np.ones(3)
    if np.linalg.det(U) * np.linalg.det(Vt) < 0.0:
        S[2] = -1.0
    R = (U * S) @ Vt
    scale = float((D * S).sum() / variance) if with_scale else 1.0
    return scale, R, mean_target - scale * R @ mean_source
