"""A leader arm with the joints of an SO-101, and the position of its tool from formulas that need no URDF."""

from __future__ import annotations

import math
from pathlib import Path

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
_AXES = ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "1 0 0")
UPPER, LOWER = 0.3, 0.2  # Length of the link from the lift to the elbow, and from the elbow to the wrist [m].
RANGE = math.pi / 2.0  # Each joint turns from minus to plus this angle [rad].


def write_urdf(folder: Path) -> Path:
    """Write the URDF. If all joints are at zero, the tool is 0.5 m in front of the base, along its x."""
    offsets = {"elbow_flex": UPPER, "wrist_flex": LOWER}
    limit = f'<limit lower="{-RANGE}" upper="{RANGE}" effort="1" velocity="1"/>'
    parts, parent = ['<link name="base"/>'], "base"
    for name, axis in zip(JOINTS, _AXES, strict=True):
        parts.append(f'<link name="{name}_link"/><joint name="{name}" type="revolute"><parent link="{parent}"/>')
        parts.append(f'<child link="{name}_link"/><origin xyz="{offsets.get(name, 0.0)} 0 0"/><axis xyz="{axis}"/>')
        parts.append(f"{limit}</joint>")
        parent = f"{name}_link"
    parts.append(
        f'<link name="tool"/><joint name="grip" type="fixed"><parent link="{parent}"/><child link="tool"/></joint>'
    )
    parts.append(
        '<link name="jaw"/><joint name="free" type="continuous"><parent link="tool"/><child link="jaw"/></joint>'
    )
    file = folder / "leader.urdf"
    file.write_text(f'<robot name="leader">{"".join(parts)}</robot>')
    return file


def place(pan: float = 0.0, lift: float = 0.0, elbow: float = 0.0) -> tuple[float, float, float]:
    """Return the position of the tool for angles of the first three joints [rad]."""
    reach = UPPER * math.cos(lift) + LOWER * math.cos(lift + elbow)
    return reach * math.cos(pan), reach * math.sin(pan), -UPPER * math.sin(lift) - LOWER * math.sin(lift + elbow)
