"""Cells for tests of grippers: the shipped cell with objects to hold, and ``CELL`` with a block on the table.

The block stands so near to the pose ``BESIDE`` of the left tool that the gripper can open only about half there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import load_config

TABLE = 0.2  # Height of the table's top [m].
# BLOCK is a block of the demo. The gripper holds it 13 mm above the block's middle.
BLOCK: dict[str, Any] = {"box": (0.04, 0.04, 0.06), "at": (0.0, 0.0, 0.013), "mass": 0.1}
GRIP = TABLE + 0.03 + 0.013  # Height of a tool that has gripped the block on the table [m].
_DOWN = pin.rpy.rpyToMatrix(np.pi, 0.0, np.pi)  # The tools point down as at home.


def cell(left: dict[str, Any] | None, right: dict[str, Any] | None = None) -> Config:
    """Return the shipped cell with an object for each gripper, or None for no object. It has no limit of solve time."""
    data = load_config("config/dual_iiwa7.yaml").model_dump()
    data["arms"]["left"]["gripper"]["object"], data["arms"]["right"]["gripper"]["object"] = left, right
    data["control"]["solve_time_limit"] = None
    return Config.model_validate(data)


def at(z: float, y: float = 0.25, x: float = 0.5) -> pin.SE3:
    """Return a pose of a tool that points down."""
    return pin.SE3(_DOWN, np.array([x, y, z]))


_FRAME_TO_TIPS = 0.013  # Distance from the tool frame to the tips of the fingers [m].

# The block's nearest face is 35 mm from the middle between the fingers. The outer side of a finger is 22 mm from this
# middle if the gripper is closed, and 47 mm if it is open.
_BLOCK = {"shape": "box", "size": (0.1, 0.04, 0.015), "position": (0.5, 0.25 + 0.055, TABLE + 0.0075)}
_DATA = load_config("config/dual_iiwa7.yaml").model_dump()
_DATA["obstacles"]["block"] = _BLOCK
CELL = Config.model_validate(_DATA)
# Without this limit, no result depends on the clock.
SETTINGS = CELL.control.model_copy(update={"solve_time_limit": None})


def tips_at(y: float, tips: float) -> pin.SE3:
    """Return a pose of the left tool, which points down. Its tips are ``tips`` [m] above the table."""
    return at(TABLE + _FRAME_TO_TIPS + tips, y)


BESIDE, ABOVE = tips_at(0.25, 0.006), tips_at(0.25, 0.06)
