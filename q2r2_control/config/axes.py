"""The axis convention of an input: which of its axes become the world's x, y and z."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from q2r2_control.types import Array

_AXES = ("x", "y", "z")
_ALLOWED = "three of +x -x +y -y +z -z that use x, y and z once each, e.g. [+z, -x, +y]"


def axes_matrix(axes: Sequence[str]) -> Array:
    """Signed permutation M, (3, 3): a position p of the input becomes M p in the world, a rotation R becomes M R M'.

    ``axes[i]`` is the input's axis that becomes the world's i-th. A determinant of -1 says that the input counts in a
    left-handed frame, as raw Unity does; M R M' is a proper rotation then too.
    Raises :class:`ValueError` that names the value and what is allowed.
    """
    matrix = np.zeros((3, 3))
    for row, axis in enumerate(axes):
        if len(axes) != 3 or len(axis) != 2 or axis[0] not in "+-" or axis[1] not in _AXES:
            raise ValueError(f"axes {list(axes)} are not {_ALLOWED}")
        matrix[row, _AXES.index(axis[1])] = 1.0 if axis[0] == "+" else -1.0
    if abs(round(float(np.linalg.det(matrix)))) != 1:
        raise ValueError(f"axes {list(axes)} are not {_ALLOWED}")
    return matrix
