"""What MuJoCo's contacts press with, by links."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np


def pressing_force(
    model: mujoco.MjModel, data: mujoco.MjData, first: Callable[[str], bool], second: Callable[[str], bool]
) -> float:
    """Sum of the normal forces [N] of all contacts between a link that is ``first`` and one that is ``second``."""
    total, wrench = 0.0, np.zeros(6)
    for i in range(data.ncon):
        contact = data.contact[i]
        a, b = (model.body(model.geom_bodyid[geom]).name for geom in (contact.geom1, contact.geom2))
        if (first(a) and second(b)) or (first(b) and second(a)):
            mujoco.mj_contactForce(model, data, i, wrench)
            total += float(wrench[0])
    return total
