"""A flange of given sizes between an arm and its tool: a cylinder, where no model of the flange is at hand."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from q2r2_control.config.arms import PoseConfig
from q2r2_control.robot.description import Description
from q2r2_control.robot.urdf_parts import fixed_joint, numbers

_BODY, _END = "flange_body", "flange_end"  # links
_COLOUR = (0.55, 0.56, 0.58, 1.0)


def cylinder_flange(thickness: float, radius: float, mass: float) -> Description:
    """A cylinder [m, m, kg] that stands on the arm's last link along z, and a link at its far end."""
    urdf = ET.Element("robot", name="flange")
    body = ET.SubElement(urdf, "link", name=_BODY)
    middle = numbers((0.0, 0.0, thickness / 2))
    if mass > 0.0:
        across = mass * (3.0 * radius**2 + thickness**2) / 12.0
        inertial = ET.SubElement(body, "inertial")
        ET.SubElement(inertial, "origin", xyz=middle)
        ET.SubElement(inertial, "mass", value=repr(mass))
        moments = {"ixx": across, "iyy": across, "izz": mass * radius**2 / 2.0, "ixy": 0.0, "ixz": 0.0, "iyz": 0.0}
        ET.SubElement(inertial, "inertia", {name: repr(moment) for name, moment in moments.items()})
    for tag in ("visual", "collision"):
        shape = ET.SubElement(body, tag, name=f"{_BODY}_{tag}")
        ET.SubElement(shape, "origin", xyz=middle)
        ET.SubElement(ET.SubElement(shape, "geometry"), "cylinder", radius=repr(radius), length=repr(thickness))
        if tag == "visual":
            material = ET.SubElement(shape, "material", name=f"{_BODY}_colour")
            ET.SubElement(material, "color", rgba=numbers(_COLOUR))
    ET.SubElement(urdf, "link", name=_END)
    urdf.append(fixed_joint(f"{_END}_mount", _BODY, _END, PoseConfig(position=(0.0, 0.0, thickness))))
    return Description(urdf=urdf, srdf=None, file=Path("flange"))
