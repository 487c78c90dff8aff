"""Algebra of small matrices, compiled: products, and of positive definite ones inverse and root.

For six to fourteen rows BLAS and LAPACK take several times as long to call as the work itself takes, most of all for
eigenvalues. Nothing here raises: a matrix that is not positive definite, or not finite, is said to be none.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.cholesky import factorise
from q2r2_control.control.jit import kernel
from q2r2_control.types import Array

# Deviation from convergence from which a series is quicker than steps that square it.
_NEARLY = 0.01
# Above it, scaling saves steps; below, it would only add rounding.
_FAR = 0.1
# Nine are enough for eigenvalues a million times apart.
_MOST_STEPS = 30
_ROUNDING = 1e-16


@kernel
def finite(rows: Array) -> bool:
    """Sums of squares are finite where all numbers are, and none is so large that it means nothing."""
    total = 0.0
    for i in range(rows.shape[0]):
        for j in range(rows.shape[1]):
            total += rows[i, j] * rows[i, j]
    return np.isfinite(total)


@kernel
def times(A: Array, x: Array, out: Array) -> None:
    """A x (n,) of A (n, k) and x (k,)."""
    for i in range(A.shape[0]):
        total = 0.0
        for k in range(A.shape[1]):
            total += A[i, k] * x[k]
        out[i] = total


@kernel
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
def solve_factor(factor: Array, B: Array) -> None:
    """L^-1 B (n, k) in place, of the lower triangle and diagonal L of ``factor``."""
    for i in range(B.shape[0]):
        for k in range(i):
            share = factor[i, k]
            if share != 0.0:  # joints of two arms have nothing to do with each other
                for j in range(B.shape[1]):
                    B[i, j] -= share * B[k, j]
        for j in range(B.shape[1]):
            B[i, j] /= factor[i, i]


@kernel
def diagonalise(A: Array, vectors: Array) -> int:
    """Eigenvalues of a symmetric A (n, n) onto its diagonal, and their ``vectors`` (n, n) as columns; returns sweeps.

    By cyclic Jacobi rotations: Golub and Van Loan, "Matrix Computations", 2013, section 8.5. What comes of a matrix
    that is not finite means nothing.
    """
    n = A.shape[0]
    for i in range(n):
        for j in range(n):
            vectors[i, j] = 1.0 if i == j else 0.0
    for sweep in range(_MOST_STEPS):
        size, rest = 0.0, 0.0
        for i in range(n):
            size += A[i, i] * A[i, i]
            for j in range(i):
                rest += A[j, i] * A[j, i]  # above the diagonal, where rotations make zeros
        if not rest > _ROUNDING**2 * size:
            return sweep
        for p in range(n - 1):
            for q in range(p + 1, n):
                if A[p, q] != 0.0:
                    _rotate(A, vectors, p, q)
    return _MOST_STEPS


@kernel
def _rotate(A: Array, vectors: Array, p: int, q: int) -> None:
    """One rotation that makes A[p, q] vanish."""
    ratio = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
    tangent = (1.0 if ratio >= 0.0 else -1.0) / (abs(ratio) + np.sqrt(ratio * ratio + 1.0))
    cosine = 1.0 / np.sqrt(tangent * tangent + 1.0)
    sine = tangent * cosine
    for k in range(A.shape[0]):
        A[k, p], A[k, q] = cosine * A[k, p] - sine * A[k, q], sine * A[k, p] + cosine * A[k, q]
        vectors[k, p], vectors[k, q] = (
            cosine * vectors[k, p] - sine * vectors[k, q],
            sine * vectors[k, p] + cosine * vectors[k, q],
        )
    for k in range(A.shape[0]):
        A[p, k], A[q, k] = cosine * A[p, k] - sine * A[q, k], sine * A[p, k] + cosine * A[q, k]


class Scratch(NamedTuple):
    """For matrices of up to n rows: the first numbers of a field, without gaps, which halves the work."""

    matrix: Array  # (n^2,)
    factor: Array  # (n^2,)
    inverse: Array  # (n^2,)
    vector: Array  # (n,)
    turned: Array  # (n,)

    @classmethod
    def empty(cls, n: int) -> Scratch:
        return cls(np.zeros(n * n), np.zeros(n * n), np.zeros(n * n), np.zeros(n), np.zeros(n))


@kernel
def root_times(A: Array, x: Array, scratch: Scratch) -> bool:
    """Make x (n,) X x, X being the symmetric positive definite root of A (n, n), X X = A; A is spoilt.

    False where A has none; then x is spoilt too. The scaled iteration of Denman and Beavers in its product form,
    X -> A^1/2 and M -> I quadratically: Higham, "Functions of Matrices", 2008, section 6.3, equations 6.28 and 6.29.
    All X and M are functions of A, so that what X makes of a vector can be followed without X. Where M is near I,
    A^1/2 = X M^-1/2 by the binomial series of M^-1/2 takes a few products with a vector instead of inverses.
    """
    n, M, turned = A.shape[0], A, scratch.turned
    inverse, factor = scratch.inverse[: n * n].reshape(n, n), scratch.factor[: n * n].reshape(n, n)
    if not finite(A):
        return False  # a maximum may pass over NaN
    times(A, x, turned)
    for i in range(n):
        x[i] = turned[i]
    for _ in range(_MOST_STEPS):
        deviation = 0.0
        for i in range(n):
            for j in range(i):
                deviation = max(deviation, abs(M[i, j]))
            deviation = max(deviation, abs(M[i, i] - 1.0))
        if deviation < _NEARLY:
            _finish_root(M, x, scratch)
            return True
        if not invert(M, factor, inverse):
            return False
        scale = 1.0
        if deviation > _FAR:
            for i in range(n):
                scale *= factor[i, i]
            scale = scale ** (-1.0 / n)  # mu; the determinant is the square of the diagonal's product
        mu, share = 0.25 * scale * scale, 0.25 / (scale * scale)
        times(inverse, x, turned)
        for i in range(n):
            x[i] = 0.5 * scale * x[i] + 2.0 * share * scale * turned[i]
            for j in range(i + 1):
                M[i, j] = mu * M[i, j] + share * inverse[i, j]
                M[j, i] = M[i, j]
            M[i, i] += 0.5
    return False


@kernel
def _finish_root(M: Array, x: Array, scratch: Scratch) -> None:
    """Make x (n,) M^-1/2 x, of an M near I: the sum of (2k - 1)!! / (2k)!! (I - M)^k x."""
    n, term, turned = M.shape[0], scratch.vector, scratch.turned
    for i in range(n):
        term[i] = x[i]
    for k in range(1, _MOST_STEPS):
        times(M, term, turned)
        size, change = 0.0, 0.0
        for i in range(n):
            term[i] = (term[i] - turned[i]) * ((k - 0.5) / k)
            x[i] += term[i]
            size, change = max(size, abs(x[i])), max(change, abs(term[i]))
        if change <= _ROUNDING * size:
            return
