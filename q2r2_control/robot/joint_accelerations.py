"""Acceleration limits of joints: where a URDF has them, and those of a cell's YAML put into it.

URDF 1.2 has the attributes ``acceleration`` and ``deceleration`` of ``limit`` (ros/urdfdom, pull request 212), and
Drake's models had ``drake:acceleration`` before. Readers that know none of them skip them, Pinocchio's among them, so
they are read here, whatever version the file claims to have.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET

ACCELERATION = "acceleration"
ATTRIBUTES = (ACCELERATION, "deceleration", "{http://drake.mit.edu}acceleration")  # of limit


def acceleration_limit(joint: ET.Element) -> float:
    """The least of a joint's limits [rad/s^2, m/s^2 of a sliding joint]; infinity where it has none.

    One number for both directions of both: to speed up as fast as the joint may brake costs little, and nothing here
    knows of two.
    """
    limit = joint.find("limit")
    written = [] if limit is None else [limit.get(attribute) for attribute in ATTRIBUTES]
    return min((float(text) for text in written if text is not None), default=math.inf)


def set_acceleration_limit(joint: ET.Element, value: float) -> None:
    """Write ``value`` [rad/s^2, m/s^2] into a joint that has limits, in place of what it says of them."""
    for limit in joint.findall("limit"):
        for attribute in ATTRIBUTES:
            limit.attrib.pop(attribute, None)
        limit.set(ACCELERATION, repr(value))
