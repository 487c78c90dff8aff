"""The shipped cell with a block on the table, so near beside the left tool that its gripper opens about half there."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config, load_config

_TABLE = 0.2  # height of its top [m]
_FRAME_TO_TIPS = 0.013  # [m]
_DOWN = pin.rpy.rpyToMatrix(np.pi, 0.0, np.pi)  # as at home: fingers slide along the world's y

# The face nearest to the tool is 35 mm from its middle; a finger's outside is at 22 mm when closed and 47 mm when open.
_BLOCK = {"shape": "box", "size": (0.1, 0.04, 0.015), "position": (0.5, 0.25 + 0.055, _TABLE + 0.0075)}


def _cell() -> Config:
    data = load_config("config/dual_iiwa7.yaml").model_dump()
    data["obstacles"]["block"] = _BLOCK
    return Config.model_validate(data)


CELL = _cell()
SETTINGS = CELL.control.model_copy(update={"solve_time_limit": None})  # no outcome hangs on the clock


def at(y: float, tips: float) -> pin.SE3:
    """The left tool pointing down with its tips this far above the table [m]."""
    return pin.SE3(_DOWN, np.array([0.5, y, _TABLE + _FRAME_TO_TIPS + tips]))


BESIDE, ABOVE = at(0.25, 0.006), at(0.25, 0.06)
