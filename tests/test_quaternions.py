"""The functions for quaternions (tuples of four floats) give the same rotations as Pinocchio."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.quaternions import (
    Quaternion,
    inverse,
    product,
    rotation_of,
    rotation_vector,
    turn_between,
    turned_by,
)
from q2r2_control.types import Array


def matrix(q: Quaternion) -> Array:
    x, y, z, w = q
    return np.array(pin.Quaternion(w, x, y, z).toRotationMatrix())


def random_vectors(count: int = 200) -> list[tuple[float, float, float]]:
    random = np.random.default_rng(3)
    axes = random.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    x, y, z = (axes * random.uniform(0.0, 3.1, count)[:, None]).T.tolist()
    return list(zip(x, y, z, strict=True))


def test_rotation_vector_and_rotation_are_inverse_functions() -> None:
    for vector in random_vectors():
        q = rotation_of(vector)
        assert matrix(q) == pytest.approx(pin.exp3(np.array(vector)), abs=1e-14)
        a, b, c, w = q
        assert rotation_vector(q) == pytest.approx(vector, abs=1e-14)
        assert rotation_vector((-a, -b, -c, -w)) == pytest.approx(vector, abs=1e-14)


def test_products_and_inverses_equal_the_products_and_inverses_of_matrices() -> None:
    for one, other in zip(random_vectors(), reversed(random_vectors()), strict=True):
        p, q = rotation_of(one), rotation_of(other)
        assert matrix(product(p, q)) == pytest.approx(matrix(p) @ matrix(q), abs=1e-14)
        assert matrix(inverse(q)) == pytest.approx(matrix(q).T, abs=1e-14)
        assert matrix(turned_by(q, turn_between(q, p))) == pytest.approx(matrix(p), abs=1e-14)
        assert turn_between(q, p) == rotation_vector(product(p, inverse(q)))


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-12, 1e-6, math.pi - 1e-6, math.pi - 1e-12], ids="{:g} rad".format)
def test_very_small_turns_and_almost_half_turns_are_exact(angle: float) -> None:
    assert rotation_vector(rotation_of((0.0, angle, 0.0))) == pytest.approx((0.0, angle, 0.0), rel=1e-14, abs=0.0)
