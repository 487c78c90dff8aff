"""Compiled algebra of small matrices is NumPy's, and says so where a matrix is not positive definite."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.compliance.small_matrices import (
    Scratch,
    diagonalise,
    invert,
    root_times,
    solve_factor,
    times,
)
from q2r2_control.control.cholesky import factorise
from q2r2_control.types import Array

RANDOM = np.random.default_rng(3)


def positive_definite(n: int, condition: float) -> Array:
    """Random, with eigenvalues from 1 to ``condition``."""
    vectors, _ = np.linalg.qr(RANDOM.normal(size=(n, n)))
    matrix: Array = (vectors * np.geomspace(1.0, condition, n)) @ vectors.T
    return 0.5 * (matrix + matrix.T)


NOT_POSITIVE_DEFINITE = [
    pytest.param(np.diag([1.0, -1e-9, 2.0]), id="indefinite"),
    pytest.param(np.ones((3, 3)), id="singular"),
    pytest.param(np.full((3, 3), np.nan), id="not finite"),
]


@pytest.mark.parametrize(("n", "k"), [(1, 1), (6, 7), (7, 6)])
def test_products_are_numpy_s_for_any_order_in_memory(n: int, k: int) -> None:
    A, x, out = RANDOM.normal(size=(n, k)), RANDOM.normal(size=k), np.zeros(n)
    for matrix in (A, np.asfortranarray(A)):
        times(matrix, x, out)
        np.testing.assert_allclose(out, A @ x, atol=1e-14)


@pytest.mark.parametrize("n", [1, 2, 6, 7, 14])
@pytest.mark.parametrize("condition", [1.0, 30.0, 1e6])
def test_factor_inverse_and_root_are_exact_to_rounding(n: int, condition: float) -> None:
    for scale in (1e-3, 1.0, 1e3):
        A = scale * positive_definite(n, condition)
        factor, inverse = np.empty_like(A), np.empty_like(A)
        assert invert(A, factor, inverse)
        np.testing.assert_allclose(np.tril(factor), np.linalg.cholesky(A), rtol=1e-9, atol=1e-12 * np.sqrt(scale))
        np.testing.assert_allclose(inverse @ A, np.eye(n), atol=1e-14 * condition * n)
        root = np.eye(n)
        for column in root:
            assert root_times(A.copy(), column, Scratch.empty(n))
        np.testing.assert_allclose(root, root.T, atol=1e-13 * np.abs(root).max())
        np.testing.assert_allclose(root @ root, A, atol=1e-13 * np.abs(A).max())
        assert np.linalg.eigvalsh(0.5 * (root + root.T)).min() > 0.0


@pytest.mark.parametrize("A", NOT_POSITIVE_DEFINITE)
def test_what_is_not_positive_definite_has_neither_inverse_nor_root(A: Array) -> None:
    assert not invert(A, np.empty_like(A), np.empty_like(A))
    assert not root_times(A.copy(), np.ones(len(A)), Scratch.empty(len(A)))


@pytest.mark.parametrize("n", [1, 6, 14])
def test_what_a_factor_s_inverse_makes_of_columns_is_numpy_s(n: int) -> None:
    A, B = positive_definite(n, 30.0), RANDOM.normal(size=(n, 7))
    factor, solved = A.copy(), B.copy()
    assert factorise(factor)
    solve_factor(factor, solved)
    np.testing.assert_allclose(np.linalg.cholesky(A) @ solved, B, atol=1e-12)


@pytest.mark.parametrize("values", [[1.0], [3.0, 3.0, 3.0], [-1.0, 0.0, 1e-9, 2.0, 2.0, 1e6]], ids=str)
def test_eigenvalues_and_vectors_are_exact_to_rounding(values: list[float]) -> None:
    n = len(values)
    turned, _ = np.linalg.qr(RANDOM.normal(size=(n, n)))
    A = (turned * np.array(values)) @ turned.T
    A = 0.5 * (A + A.T)
    diagonal, vectors = A.copy(), np.zeros((n, n))
    assert diagonalise(diagonal, vectors) <= 10, "and in few sweeps"
    size = np.abs(values).max()
    np.testing.assert_allclose(np.sort(np.diag(diagonal)), values, atol=1e-14 * size)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-14)
    np.testing.assert_allclose((vectors * np.diag(diagonal)) @ vectors.T, A, atol=1e-14 * size)


def test_eigenvalues_a_million_times_apart_take_few_sweeps() -> None:
    for _ in range(300):
        assert diagonalise(positive_definite(6, 1e6), np.zeros((6, 6))) <= 10


def test_the_eigenvalues_of_what_is_not_finite_end_in_time() -> None:
    diagonalise(np.full((6, 6), np.nan), np.zeros((6, 6)))
