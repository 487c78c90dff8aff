"""Make the URDF and SRDF elements of a cell: rename elements of models, or build them from the configuration."""

from __future__ import annotations

import copy
import math
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Callable, Collection, Sequence

from q2r2_control.config.arms import PoseConfig
from q2r2_control.config.cell import ObstacleConfig
from q2r2_control.robot.urdf_forms import scale_to_metres

WORLD = "world"  # The root link of every cell.

# Range of a joint without limits: two turns in each direction [rad].
CONTINUOUS_RANGE = 4 * math.pi

# Elements that name links or joints, and the attribute that contains the name.
_NAMING = {"parent": "link", "child": "link", "mimic": "joint"}


def renamed(part: ET.Element, name_of: Callable[[str], str]) -> ET.Element:
    """Return a copy of a link, joint or material with every name in it changed by ``name_of``."""
    part = copy.deepcopy(part)
    for element in part.iter():
        if element.tag in _NAMING:
            attribute = _NAMING[element.tag]
            element.set(attribute, name_of(element.get(attribute, "")))
        elif element.get("name"):
            element.set("name", name_of(element.get("name", "")))
    return part


def renamed_exclusions(parts: Sequence[ET.Element], name_of: Callable[[str], str]) -> list[ET.Element]:
    """Return copies of those elements of an SRDF that disable collisions, with links renamed by ``name_of``."""
    naming = {"disable_collisions": ("link1", "link2"), "disable_default_collisions": ("link",)}
    found = [copy.deepcopy(part) for part in parts if part.tag in naming]
    for part in found:
        for attribute in naming[part.tag]:
            part.set(attribute, name_of(part.get(attribute, "")))
    return found


def shape_from_drawings(links: Sequence[ET.Element], names: Collection[str]) -> None:
    """Give each link in ``names`` that has no collision shape the shapes of its <visual> elements."""
    for link in links:
        if link.get("name") in names and link.find("collision") is None:
            for drawing in link.findall("visual"):
                shape = ET.SubElement(link, "collision")
                shape.extend(copy.deepcopy(part) for part in drawing if part.tag in ("origin", "geometry"))
                # Only the collision shapes are scaled. The <visual> elements keep their units, as RViz expects.
                scale_to_metres(shape.iter("mesh"))


def name_shapes(links: Sequence[ET.Element]) -> None:
    """Give every shape a unique name, which MuJoCo needs.

    Shapes without a name or with a shared name are named after their link.
    """
    for tag in ("collision", "visual"):
        used = Counter(shape.get("name") for link in links for shape in link.findall(tag))
        for link in links:
            for index, shape in enumerate(link.findall(tag)):
                if not shape.get("name") or used[shape.get("name")] > 1:
                    shape.set("name", f"{link.get('name')}_{tag}_{index}")


def fixed_joint(name: str, parent: str, child: str, pose: PoseConfig) -> ET.Element:
    """Return a fixed joint that places ``child`` in ``parent``."""
    joint = ET.Element("joint", name=name, type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=numbers(pose.position), rpy=numbers(pose.rpy))
    return joint


def obstacle_link(name: str, config: ObstacleConfig) -> ET.Element:
    """Return an obstacle as a link. Its name may have only letters, digits and _."""
    if config.shape == "box":
        shape = f'<box size="{numbers(config.size)}"/>'
    elif config.shape == "sphere":
        shape = f'<sphere radius="{config.size[0]}"/>'
    else:
        shape = f'<cylinder radius="{config.size[0]}" length="{config.size[1]}"/>'
    colour = f'<material name="{name}_colour"><color rgba="{numbers(config.colour)}"/></material>'
    capsule = f'<collision_checking><capsule name="{name}_collision"/></collision_checking>'
    return ET.fromstring(
        f"""<link name="{name}"><visual name="{name}_visual"><geometry>{shape}</geometry>{colour}</visual>
        <collision name="{name}_collision"><geometry>{shape}</geometry></collision>
        {capsule if config.shape == "capsule" else ""}</link>"""
    )


def numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)


ACCELERATION = "acceleration"
# The attributes of <limit> that limit the acceleration of a joint.
ATTRIBUTES = (ACCELERATION, "deceleration", "{http://drake.mit.edu}acceleration")


def mimic_of(joint: ET.Element) -> tuple[str, float, float] | None:
    """Return the name of the joint that ``joint`` mimics, the multiplier and the offset; None if it mimics no joint."""
    if (mimic := joint.find("mimic")) is None:
        return None
    return mimic.get("joint", ""), float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))


def acceleration_limit(joint: ET.Element) -> float:
    """Return the least acceleration limit of a joint [rad/s^2, or m/s^2 of a sliding joint]; infinity without limits.

    The number is valid for both directions, and for speeding up and braking.
    """
    limit = joint.find("limit")
    written = [] if limit is None else [limit.get(attribute) for attribute in ATTRIBUTES]
    return min((float(text) for text in written if text is not None), default=math.inf)


def set_acceleration_limit(joint: ET.Element, value: float) -> None:
    """Replace the acceleration limits of a joint that has a <limit> by ``value`` [rad/s^2 or m/s^2]."""
    for limit in joint.findall("limit"):
        for attribute in ATTRIBUTES:
            limit.attrib.pop(attribute, None)
        limit.set(ACCELERATION, repr(value))
