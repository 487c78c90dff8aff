"""Small symmetric positive definite matrices, compiled: Cholesky factor and inverse.

For matrices of six or fourteen rows LAPACK takes several times as long as the work itself does. Nothing here raises: a
matrix that is not positive definite, or not finite, is said to be none.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.jit import lean_kernel
from q2r2_control.types import Array


@lean_kernel
def factorise(A: Array) -> bool:
    """Cholesky factor of a symmetric A, read from its upper triangle, into the lower one and the diagonal.

    False where A is not positive definite; A is spoilt then.
    """
    for j in range(A.shape[0]):
        diagonal = A[j, j]
        for k in range(j):
            diagonal -= A[j, k] * A[j, k]
        if not diagonal > 0.0:
            return False
        A[j, j] = np.sqrt(diagonal)
        for i in range(j + 1, A.shape[0]):
            value = A[j, i]
            for k in range(j):
                value -= A[i, k] * A[j, k]
            A[i, j] = value / A[j, j]
    return True


@lean_kernel
def invert(A: Array, factor: Array, inverse: Array) -> bool:
    """``inverse`` of a symmetric A, and its Cholesky ``factor``; False where A is not positive definite."""
    n = A.shape[0]
    for j in range(n):
        for i in range(j, n):
            factor[j, i] = A[j, i]
    if not factorise(factor):
        return False
    # The inverse of the factor, above the diagonal: row j of it transposed.
    for j in range(n):
        inverse[j, j] = 1.0 / factor[j, j]
        for i in range(j + 1, n):
            value = 0.0
            for k in range(j, i):
                value -= factor[i, k] * inverse[j, k]
            inverse[j, i] = value / factor[i, i]
    for j in range(n):
        for i in range(j, n):
            value = 0.0
            for k in range(i, n):
                value += inverse[j, k] * inverse[i, k]
            inverse[j, i] = value
    for j in range(n):
        for i in range(j):
            inverse[j, i] = inverse[i, j]
    return True
