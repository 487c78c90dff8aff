"""Compute something on a controller's own data, and then restore these data."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from q2r2_control.control.live_settings import arrays_in


@contextmanager
def put_back(values: tuple[Any, ...], objects: Iterable[object]) -> Iterator[None]:
    """When the block ends, restore all arrays in ``values`` and the attributes of ``objects`` exactly.

    Args:
        values: Tuples of arrays, which may be nested, as kernels read them.
        objects: Objects whose attributes are replaced in the block. An array that is changed in place must be in
            ``values``.
    """
    arrays = [(array, array.copy()) for array in arrays_in(values)]
    attributes = [(vars(one), dict(vars(one))) for one in objects]
    try:
        yield
    finally:
        for array, before in arrays:
            array[...] = before
        for now, kept in attributes:
            now.clear()
            now.update(kept)
