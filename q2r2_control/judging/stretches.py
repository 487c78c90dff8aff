"""Where something goes on without a break."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def stretches(flags: npt.NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Beginning and end (exclusive) of each run of true ``flags`` (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False]))))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]
