"""Rotations as matrices and as vectors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

__all__ = ["rotation_matrix", "rotation_vector"]

_SMALL_ANGLE = 1e-7


def rotation_vector(rotation: ArrayLike) -> NDArray[np.float64]:
    """Returns axis times angle of a rotation matrix.

    Args:
        rotation (ArrayLike): rotation matrix ``[3, 3]``.

    Returns:
        numpy.ndarray: vector ``[3]``. Its direction is the axis; its length is the
        angle, in radians, between 0 and pi.

    Raises:
        ValueError: the matrix has another shape.

    Examples:
        >>> import numpy as np
        >>> turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        >>> rotation_vector(turn).round(4).tolist()
        [0.0, 0.0, 1.5708]
    """
    matrix = np.asarray(rotation, dtype=np.float64)
    if matrix.shape != (3, 3):
        raise ValueError(f"rotation has shape {matrix.shape}, expected (3, 3)")
    # The quaternion's largest component first: stable at every angle, pi included.
    diagonal = np.diag(matrix)
    squares = np.concatenate([[diagonal.sum()], 2 * diagonal - diagonal.sum()]) + 1
    largest = int(squares.argmax())
    skew = np.array(
        [
            matrix[2, 1] - matrix[1, 2],
            matrix[0, 2] - matrix[2, 0],
            matrix[1, 0] - matrix[0, 1],
        ]
    )
    quaternion = np.empty(4)
    if largest == 0:
        quaternion[0] = squares[0]
        quaternion[1:] = skew
    else:
        axis = largest - 1
        quaternion[0] = skew[axis]
        quaternion[1:] = matrix[axis] + matrix[:, axis]
        quaternion[largest] = squares[largest]
    quaternion /= np.linalg.norm(quaternion)
    if quaternion[0] < 0:
        quaternion = -quaternion
    sine = float(np.linalg.norm(quaternion[1:]))
    if sine < _SMALL_ANGLE:
        return 2 * quaternion[1:]
    return quaternion[1:] * (2 * np.arctan2(sine, quaternion[0]) / sine)


def rotation_matrix(vector: ArrayLike) -> NDArray[np.float64]:
    """Returns the rotation matrix of a rotation vector.

    Args:
        vector (ArrayLike): axis times angle, ``[3]``, radians.

    Returns:
        numpy.ndarray: rotation matrix ``[3, 3]``.

    Examples:
        >>> import numpy as np
        >>> rotation_matrix([0.0, 0.0, np.pi / 2]).round(4).tolist()
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
    """
    vector = np.asarray(vector, dtype=np.float64)
    angle = float(np.linalg.norm(vector))
    if angle < 1e-9:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
