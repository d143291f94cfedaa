"""Quaternions w, x, y, z (scalar first) and rotation matrices."""

import numpy as np


def quat_to_matrix(quat: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] of a unit quaternion w, x, y, z."""
    w, x, y, z = quat / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_to_quat(matrix: np.ndarray) -> np.ndarray:
    """Return the unit quaternion [4] w, x, y, z (w not negative) of a rotation [3, 3], at any angle."""
    m = matrix
    K = np.array(
        [
            [m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
            [0, m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
            [0, 0, m[1, 1] - m[0, 0] - m[2, 2], m[1, 2] + m[2, 1]],
            [0, 0, 0, m[2, 2] - m[0, 0] - m[1, 1]],
        ]
    )
    # the eigenvector of the largest eigenvalue of this symmetric matrix (Bar-Itzhack 2000)
    _, vectors = np.linalg.eigh(np.triu(K) + np.triu(K, 1).T)
    quat = vectors[:, -1]
    return quat if quat[0] >= 0 else -quat


def slerp(a: np.ndarray, b: np.ndarray, u: float) -> np.ndarray:
    """Return the unit quaternion a share `u` of the way from `a` to `b`."""
    b = b if a @ b >= 0 else -b
    angle = np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b)) * 2
    if angle < 1e-9:
        mixed = (1 - u) * a + u * b
    else:
        mixed = (np.sin((1 - u) * angle) * a + np.sin(u * angle) * b) / np.sin(angle)
    return matrix_to_quat(quat_to_matrix(mixed))  # unit, w not negative
