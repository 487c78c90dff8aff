"""Ask a user's own tasks and constraints for their matrices and vectors, and check the answers.

A step never raises an exception. If an answer cannot be used, a line of text therefore says what is wrong with it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from q2r2_control.errors import raised
from q2r2_control.types import Array

Answer = tuple[Array, Array]
# If a user's function raises an exception, the line contains at most this many characters of the exception's text.
_MAX_LENGTH = 120


def answer_of(ask: Callable[[Array, Array], object], q: Array, v: Array, shapes: str = "") -> Answer | str:
    """Call a user's function for a joint state, and check the matrix and the vector that it returns.

    Args:
        ask: The user's function. It gets copies of ``q`` and ``v``. It may raise any exception or return any object.
        q: Joint positions (nv,) [rad].
        v: Joint velocities (nv,) [rad/s].
        shapes: Text that names the allowed shapes in the line; "" if these shapes are (k, nv) and (k,).

    Returns:
        A finite matrix (k, nv) and vector (k,), or one line that says why the answer cannot be used.
    """
    try:
        answer = ask(q.copy(), v.copy())
        if not isinstance(answer, tuple | list) or len(answer) != 2:
            return f"returned {type(answer).__name__}; allowed: a matrix and a vector"
        matrix, vector = (np.asarray(part, dtype=np.float64) for part in answer)
    except Exception as error:
        return f"raised {raised(error, _MAX_LENGTH)}"
    nv = len(q)
    if matrix.ndim != 2 or matrix.shape[1] != nv or vector.shape != matrix.shape[:1]:
        return f"returned shapes {matrix.shape} and {vector.shape}; allowed: {shapes or f'(k, {nv}) and (k,)'}"
    if not (np.isfinite(matrix).all() and np.isfinite(vector).all()):
        return "returned a number that is not finite"
    return matrix, vector
