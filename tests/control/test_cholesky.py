"""Compiled Cholesky factors are NumPy's, and a matrix that is not positive definite has none."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.control.cholesky import factorise, substitute
from q2r2_control.types import Array

RANDOM = np.random.default_rng(4)


def positive_definite(n: int, condition: float) -> Array:
    """Random, with eigenvalues from 1 to ``condition``."""
    vectors, _ = np.linalg.qr(RANDOM.normal(size=(n, n)))
    matrix: Array = (vectors * np.geomspace(1.0, condition, n)) @ vectors.T
    return 0.5 * (matrix + matrix.T)


def test_the_factor_is_read_from_the_upper_triangle() -> None:
    A = positive_definite(6, 30.0)
    spoilt = np.triu(A)
    assert factorise(spoilt)
    np.testing.assert_allclose(np.tril(spoilt), np.linalg.cholesky(A), atol=1e-12)


@pytest.mark.parametrize(
    "A",
    [
        pytest.param(np.diag([1.0, -1e-9, 2.0]), id="indefinite"),
        pytest.param(np.ones((3, 3)), id="singular"),
        pytest.param(np.full((3, 3), np.nan), id="not finite"),
    ],
)
def test_what_is_not_positive_definite_has_no_factor(A: Array) -> None:
    assert not factorise(A.copy())


@pytest.mark.parametrize("n", [1, 6, 12, 14])
@pytest.mark.parametrize("condition", [1.0, 1e4])
def test_substitution_solves_the_equations(n: int, condition: float) -> None:
    A, b = positive_definite(n, condition), RANDOM.normal(size=n)
    factor, x = A.copy(), b.copy()
    assert factorise(factor)
    substitute(factor, x)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), atol=1e-13 * condition)
