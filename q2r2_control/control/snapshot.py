"""Let something be worked out as if it happened, and put everything back as it was."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

from q2r2_control.control.live_settings import arrays_in


@contextmanager
def put_back(values: tuple[Any, ...], objects: Iterable[object]) -> Iterator[None]:
    """Restore, to the bit, all arrays within ``values`` and the attributes of ``objects`` when the block ends.

    Args:
        values: Tuples of arrays, also within each other, as kernels read them.
        objects: Whose attributes are replaced, never changed in place. Arrays among them that are, are in ``values``.
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
