"""Statistics of features, by which policies normalise: of an episode, and of all together.

Which ones there are, and that quantiles of many episodes are the mean of theirs, weighted by frames, is as LeRobot has
it (``lerobot/datasets/compute_stats.py`` of lerobot 0.4.4), so that datasets of both can be joined.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
NAMES = ("min", "max", "mean", "std", "count", *QUANTILES)

Statistics = dict[str, npt.NDArray[Any]]  # by name; each has the size of the feature, but for count


def statistics_of(column: npt.NDArray[Any]) -> Statistics:
    """Statistics of the n rows of a column, (n, size) or (n,); a quantile is the row that so many are not above."""
    rows = column if column.ndim == 2 else column[:, None]
    numbers = rows.astype(np.float64)
    quantiles = np.quantile(numbers, list(QUANTILES.values()), axis=0, method="inverted_cdf")
    return {
        "min": rows.min(axis=0),
        "max": rows.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(rows)]),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def joined(parts: Sequence[Mapping[str, npt.NDArray[Any]]]) -> Statistics:
    """Statistics of one feature over all episodes, of those of each."""
    values = {name: np.stack([part[name] for part in parts]) for name in NAMES}
    counts = values["count"]
    total = counts.sum(axis=0)
    mean = (values["mean"] * counts).sum(axis=0) / total
    variance = ((values["std"] ** 2 + (values["mean"] - mean) ** 2) * counts).sum(axis=0) / total
    return {
        "min": values["min"].min(axis=0),
        "max": values["max"].max(axis=0),
        "mean": mean,
        "std": np.sqrt(variance),
        "count": total,
        **{name: (values[name] * counts).sum(axis=0) / total for name in QUANTILES},
    }
