"""OpenGL's and Blender's camera axes: x right, y up, z backwards; turned into ours, OpenCV's, and back."""

import numpy as np

from ground.formats.pictures.files import FormatError

FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])


def opengl_to_world_to_camera(camera_to_world: object, where: str) -> np.ndarray:
    """Return world_to_camera [4, 4], OpenCV axes, of a camera-to-world matrix in OpenGL axes.

    Raises:
        FormatError: it is not a rotation with a translation.
    """
    try:
        matrix = np.array(camera_to_world, dtype=np.float64)
    except (ValueError, TypeError) as error:
        raise FormatError(f"{where}: transform_matrix is not a matrix of numbers") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise FormatError(
            f"{where}: transform_matrix must be 4x4 finite numbers, got shape {list(matrix.shape)}"
        )
    R = matrix[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3 or np.linalg.det(R) < 0:
        raise FormatError(f"{where}: transform_matrix holds no rotation")
    return rigid_inverse(matrix @ FLIP_YZ)


def world_to_camera_to_opengl(world_to_camera: np.ndarray) -> np.ndarray:
    """Return the camera-to-world matrix [4, 4] in OpenGL axes."""
    return rigid_inverse(world_to_camera) @ FLIP_YZ


def rigid_inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse [4, 4] of a rotation with a translation."""
    inverse = np.eye(4)
    inverse[:3, :3] = matrix[:3, :3].T
    inverse[:3, 3] = -matrix[:3, :3].T @ matrix[:3, 3]
    return inverse
