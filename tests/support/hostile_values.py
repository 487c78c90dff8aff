"""Values that no argument of a public function allows, or only a few arguments allow."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

HOSTILE: dict[str, Any] = {
    "a huge integer": 10**400,
    "a huge negative integer": -(10**400),
    "an integer too long to print": 10**5000,
    "not a number": float("nan"),
    "infinity": float("inf"),
    "a complex number": 1j,
    "a truth value": True,
    "a text": "0.001",
    "bytes": b"\x00",
    "none": None,
    "an object": object(),
    "a ragged list": [[1.0], [2.0, 3.0]],
    "a list of huge integers": [10**400] * 14,
    "a list of texts": ["0"] * 14,
    "numbers and none": [0.0] * 13 + [None],
    "an empty array": np.zeros(0),
    "a column": np.zeros((14, 1)),
    "an array of objects": np.array([object()] * 14),
    "an array of complex numbers": np.zeros(14, dtype=complex),
    "an array with one that is no number": np.append(np.zeros(13), np.nan),
    "a masked array": np.ma.masked_all(14),
    "a pose of no numbers": pin.SE3(np.full((4, 4), np.nan)),
    "a class": int,
    "a mapping": {"left": 1.0},
}
