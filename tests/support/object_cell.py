"""The shipped cell with objects that its grippers hold."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config, load_config

TABLE = 0.2  # height of its top [m]
# A block of the demo, gripped 13 mm above its middle.
BLOCK: dict[str, Any] = {"box": (0.04, 0.04, 0.06), "at": (0.0, 0.0, 0.013), "mass": 0.1}
GRIP = TABLE + 0.03 + 0.013  # height of a tool that has gripped it on the table [m]
_DOWN = pin.rpy.rpyToMatrix(np.pi, 0.0, np.pi)  # as at home


def cell(left: dict[str, Any] | None, right: dict[str, Any] | None = None) -> Config:
    """With these objects, and nothing that hangs on the clock."""
    data = load_config("config/dual_iiwa7.yaml").model_dump()
    data["arms"]["left"]["gripper"]["object"], data["arms"]["right"]["gripper"]["object"] = left, right
    data["control"]["solve_time_limit"] = None
    return Config.model_validate(data)


def at(z: float, y: float = 0.25, x: float = 0.5) -> pin.SE3:
    """A tool that points down."""
    return pin.SE3(_DOWN, np.array([x, y, z]))
