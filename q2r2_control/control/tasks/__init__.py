"""What the arms should do, as costs of the QP: kernels that add to H and g of  1/2 v' H v + g' v.

``frame`` follows a tool target; ``posture`` holds joints and uses those that no tool needs; ``swivel`` turns elbows and
``manipulability`` betters postures in the tools' nullspace. Which arm gives way is a matter of their weights. Each
takes a ``TaskModel`` (fixed) and ``TaskData`` (rewritten at each tick).
"""

from q2r2_control.control.tasks.frame import add_stretch_damping, add_tool_task, tool_jacobian, tool_pose, wanted_twist
from q2r2_control.control.tasks.manipulability import add_manipulability
from q2r2_control.control.tasks.posture import (
    add_hold_task,
    add_posture_task,
    factor_of_tools,
    project_to_nullspace,
    pull_to_posture,
)
from q2r2_control.control.tasks.swivel import turn_elbows, write_swivel_rows
from q2r2_control.control.tasks.task_data import Targets, TaskData
from q2r2_control.control.tasks.task_model import TaskModel, tools_of

__all__ = [
    "Targets",
    "TaskData",
    "TaskModel",
    "add_hold_task",
    "add_manipulability",
    "add_posture_task",
    "add_stretch_damping",
    "add_tool_task",
    "factor_of_tools",
    "project_to_nullspace",
    "pull_to_posture",
    "tool_jacobian",
    "tool_pose",
    "tools_of",
    "turn_elbows",
    "wanted_twist",
    "write_swivel_rows",
]
