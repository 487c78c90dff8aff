"""Algebra of small matrices, compiled: products, and of positive definite ones Cholesky factor, inverse, square root.

For six to fourteen rows BLAS and LAPACK take several times as long to call as the work itself takes, most of all for
eigenvalues. Nothing here raises: a matrix that is not positive definite, or not finite, is said to be none.
"""

from __future__ import annotations

import numpy as np

from q2r2_control.control.jit import kernel, lean_kernel
from q2r2_control.types import Array

# Deviation from convergence from which the next step, which squares it, is exact.
_NEARLY = 1e-8
# Above it, scaling saves steps; below, it would only add rounding.
_FAR = 0.1
# Nine are enough for eigenvalues a million times apart.
_MOST_STEPS = 30


@kernel
def product(A: Array, B: Array) -> Array:
    """A B (n, m) of A (n, k) and B (k, m)."""
    out = np.zeros((A.shape[0], B.shape[1]))
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            for j in range(B.shape[1]):
                out[i, j] += A[i, k] * B[k, j]
    return out


@kernel
def times(A: Array, x: Array) -> Array:
    """A x (n,) of A (n, k) and x (k,)."""
    out = np.zeros(A.shape[0])
    for i in range(A.shape[0]):
        for k in range(A.shape[1]):
            out[i] += A[i, k] * x[k]
    return out


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
    """``inverse`` of a symmetric A, and its Cholesky ``factor``; False where A is not positive definite.

    Of ``factor`` only the lower triangle and the diagonal mean anything afterwards.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(i, n):
            factor[i, j] = A[i, j]
    if not factorise(factor):
        return False
    # The inverse of the factor, above the diagonal where the factor is no longer needed: its columns as rows.
    for i in range(n):
        share = 1.0 / factor[i, i]
        for j in range(i):
            value = 0.0
            for k in range(j, i):
                value -= factor[i, k] * inverse[j, k]
            inverse[j, i] = value * share
        inverse[i, i] = share
    for i in range(n):
        for j in range(i, n):
            value = 0.0
            for k in range(j, n):
                value += inverse[i, k] * inverse[j, k]
            inverse[i, j] = value
            inverse[j, i] = value
    return True


@kernel
def square_root(A: Array) -> tuple[Array, bool]:
    """The symmetric positive definite X (n, n) with X X = A; False, and no X, where A is not positive definite.

    The scaled iteration of Denman and Beavers in its product form, X -> A^1/2 and M -> I quadratically: Higham,
    "Functions of Matrices", 2008, section 6.3, equations 6.28 and 6.29.
    """
    n = A.shape[0]
    X, M = A.copy(), A.copy()
    inverse, factor = np.empty((n, n)), np.empty((n, n))
    for _ in range(_MOST_STEPS):
        deviation = 0.0
        for i in range(n):
            for j in range(i):
                deviation = max(deviation, abs(M[i, j]))
            deviation = max(deviation, abs(M[i, i] - 1.0))
        if not invert(M, factor, inverse):
            return X, False
        scale = 1.0
        if deviation > _FAR:
            for i in range(n):
                scale *= factor[i, i]
            scale = scale ** (-1.0 / n)  # mu; the determinant is the square of the diagonal's product
        square = scale * scale
        turned = product(X, inverse)
        for i in range(n):
            for j in range(i + 1):
                # Symmetric but for rounding, which must not add up.
                X[i, j] = 0.5 * scale * (X[i, j] + 0.5 * (turned[i, j] + turned[j, i]) / square)
                X[j, i] = X[i, j]
                M[i, j] = 0.25 * (square * M[i, j] + inverse[i, j] / square)
                M[j, i] = M[i, j]
            M[i, i] += 0.5
        if deviation < _NEARLY:
            return X, True
    return X, False
