"""The YAML that ``q2r2 new-cell`` writes, with comments on the values that a user may have to change."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import yaml

from q2r2_control.robot.robot import Robot


def commented_yaml(data: Mapping[str, Any], robot: Robot) -> str:
    """Return the ``data`` of a cell as YAML with comments. ``robot`` is the robot of this cell."""
    lines = [
        "# Written by q2r2 new-cell; change what is not true. config/dual_iiwa7.yaml explains every key.",
        f"name: {_flow(data['name'])}",
        "",
    ]
    where = "# of the model's root link: x forwards, y left, z up, and rpy: [0, 0, 0] turns it; measure it [m]"
    if "robot" in data:
        lines += ["robot:", *(f"  {key}: {_flow(value)}" for key, value in data["robot"].items() if key != "mount")]
        lines += [f"  mount: {_flow(data['robot']['mount'])}   {where}", ""]
    lines.append("arms:")
    for side, arm in data["arms"].items():
        tool = " ".join(f"{value:.2f}" for value in robot.tool_pose(robot.home, side).translation)
        lines.append(f"  {side}:")
        comments = {
            "mount": where,
            "tip": "# last link, which the operator moves",
            "gripper": "# guessed: see it open and close [rad or m]",
            "home": f"# found: tool at {tool} m [rad]",
        }
        for key in ("model", "xacro_args", "mount", "tip", "gripper", "home"):
            if key in arm:
                comment = comments.get(key, "") if key == "home" or side == next(iter(data["arms"])) else ""
                lines.append(f"    {key}: {_flow(arm[key])}   {comment}".rstrip())
    cabinet = "{cabinet: {shape: box, size: [0.2, 1.4, 1.0], position: [-0.7, 0.0, 0.5]}}"
    lines += ["", f"obstacles: {{}}   # what stands around [m], such as {cabinet}"]
    if "srdf" in data:
        lines.append(f"srdf: {_flow(data['srdf'])}   # pairs of links that cannot meet")
    if capsules := data.get("capsules"):
        lines.append(f"capsules: {_flow(capsules)}   # for each mesh, or drawing, of these links")
    if control := data.get("control"):
        lines += ["", "control:"]
        if "acceleration_limit" in control:
            why = "# the model has none; a full stop stays within its torques [rad/s^2]"
            lines.append(f"  acceleration_limit: {control['acceleration_limit']}   {why}")
        if "pairs" in control:
            lines.append("  pairs:   # links that are as near as this in every posture [m]")
            lines += [f"    - {_flow(pair)}" for pair in control["pairs"]]
    return "\n".join(lines) + "\n"


def _flow(value: Any) -> str:
    """Return a value as YAML in one line."""
    return str(yaml.safe_dump([value], default_flow_style=True, sort_keys=False, width=math.inf)).strip()[1:-1]
