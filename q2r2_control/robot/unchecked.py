"""Find links that have no collision shape, so that nothing keeps them apart from other bodies.

A certificate says nothing about such a link. Every part that commands arms calls :func:`check_watched`, which refuses a
robot if such a link moves with an arm and the cell does not name the link. For a link that stands still, there is only
a note: many models have such links only for display, and other parts of the model often stand in front of them.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from q2r2_control.errors import RobotError
from q2r2_control.robot.description import LinkTree

if TYPE_CHECKING:
    from q2r2_control.robot.robot import Robot

# A link that is lighter than this counts as a frame [kg]. In models, frames of sensors and tools have 0.1 mg to 10 g,
# because some programs need a mass. The lightest real body without a shape in known models is a jaw of 20 g.
LIGHTEST_BODY = 0.015


@dataclass(frozen=True, slots=True)
class CellLink:
    """A link of a cell, and what its model says about its body."""

    name: str
    mass: float | None  # [kg]; None if the model has no mass.
    drawn: bool  # Whether it has a <visual>.
    shaped: bool  # Whether it has a <collision>.
    # If a joint beside the arm moves this link: the joint of the arm that it mimics. The link is watched only at home.
    follows: str | None
    arms: tuple[str, ...]  # The arms that move it; empty if the link stands still.

    @property
    def is_body(self) -> bool:
        """Whether the link is a real body and not a frame.

        A link is a body if it has a mass, or if it is drawn and no mass is known. If the link stands still, its mass
        says nothing, because models give any mass to such links.
        """
        if self.shaped or self.mass is None or not self.arms:
            return self.shaped or self.drawn
        return self.mass >= LIGHTEST_BODY

    @property
    def is_unchecked(self) -> bool:
        """Whether the link is a body that is not watched, or is watched only at its pose at home."""
        return self.is_body and (not self.shaped or self.follows is not None)

    def fault(self, in_cell: bool) -> str:
        """Return one line about what is missing and how to mend it.

        With ``in_cell`` the line names keys of the cell's YAML, and without it arguments of :meth:`Robot.from_urdf`.
        """
        named = _named([self.name], in_cell)
        if self.follows is not None:
            moves = f"follows {self.follows} as its joint mimics it, and would be watched where it is at home"
            return f"{self.name}: {moves}; allowed: a fixed joint in its model, or {named}"
        what = "is drawn" if self.mass is None else f"weighs {self.mass:.3g} kg"
        shape = f", capsules: {{{self.name}: 1}} around its drawing" if in_cell and self.drawn else ""
        return (
            f"{self.name}: {what} and has no collision shape, so that nothing keeps it off anything; "
            f"allowed: <collision> in its model{shape}, or {named}"
        )


def links_of(robot: Robot) -> list[CellLink]:
    """Return all links of ``robot``, including frames."""
    urdf = ET.fromstring(robot.urdf)
    tree, found = LinkTree(urdf, robot.name), []
    for link in urdf.findall("link"):
        name = link.get("name", "")
        follows = robot.following_links.get(name)
        movers = {joint.get("name", "") for joint in tree.chain(name)} | {follows}
        arms = [arm for arm, its in robot.arms.items() if movers & {robot.joint_names[joint] for joint in its.joints}]
        masses = [float(mass.get("value", "0")) for mass in link.findall("inertial/mass")]
        mass = sum(masses) if any(masses) else None
        drawn, shaped = (link.find(tag) is not None for tag in ("visual", "collision"))
        found.append(CellLink(name, mass, drawn, shaped, follows, tuple(arms)))
    return found


def unchecked_faults(robot: Robot, in_cell: bool = True) -> list[str]:
    """Return one line for each moving link or arm that keeps no distance, unless ``unchecked_links`` names it.

    With ``in_cell`` the lines name keys of the cell's YAML as remedies, and without it arguments of
    :meth:`Robot.from_urdf`.
    """
    named, moving = set(robot.unchecked_links), [link for link in links_of(robot) if link.arms]
    faults, told = [], set[str]()
    for arm in robot.arms:
        if (lacks := _lack_of(robot, arm)) is None:
            continue
        of_arm = [link for link in moving if arm in link.arms and not link.shaped]
        named_best = [link.name for link in of_arm if link.is_body] or [link.name for link in of_arm]
        links = named_best or [robot.arms[arm].tool_frame]
        if not set(links) <= named:
            told |= set(links)
            allowed = f"allowed: <collision> in the model, or {_named(links, in_cell)}"
            faults.append(f"{arm} arm: {lacks}, so that nothing keeps {', '.join(links)} off anything; {allowed}")
    unchecked = [link for link in moving if link.is_unchecked and link.name not in named | told]
    return faults + [link.fault(in_cell) for link in unchecked]


def check_watched(robot: Robot, where: str, in_cell: bool = True) -> None:
    """Raise :class:`RobotError` with ``where`` and all lines of :func:`unchecked_faults`, if there are any."""
    if faults := unchecked_faults(robot, in_cell):
        raise RobotError(f"{where}: {'; '.join(faults)}", [f"{where}: {fault}" for fault in faults])


def unchecked_notes(robot: Robot) -> Iterator[str]:
    """Yield lines about links that are not watched, because the cell names them, they stand still or they are light."""
    links = links_of(robot)
    named = [link for link in links if link.shaped and link.name in robot.unchecked_links]
    at_home, watched = ([link.name for link in named if bool(link.follows) is follows] for follows in (True, False))
    if alone := [name for name in robot.unchecked_links if name not in (*at_home, *watched)]:
        yield f"unchecked_links: nothing keeps {', '.join(alone)} off anything"
    if at_home:
        yield f"unchecked_links: watched only where they are at home: {', '.join(at_home)}"
    if watched:
        yield f"unchecked_links: watched all the same, since they have collision shapes: {', '.join(watched)}"
    still = [link.name for link in links if link.is_unchecked and not link.arms]
    if unguarded := [name for name in still if name not in robot.unchecked_links]:
        around = f"capsules: {{{', '.join(f'{name}: 1' for name in unguarded)}}} around the drawings"
        yield (
            f"nothing keeps the arms off links that stand still and are drawn without a collision shape: "
            f"{', '.join(unguarded)}; to change: <collision> in the model, {around}, or unchecked_links"
        )
    if frames := [link.name for link in links if link.drawn and not link.is_body]:
        lighter = f"drawn, without a collision shape, and lighter than {1e3 * LIGHTEST_BODY:g} g"
        yield f"not watched, since taken for frames ({lighter}): {', '.join(frames)}"


def _lack_of(robot: Robot, arm: str) -> str | None:
    """Return why a whole arm has no monitored pair; None if it has one."""
    joints = robot.arms[arm].joints
    # The index of a joint in Pinocchio's model is one more than its index in vectors, because the world comes first.
    of_body = {index: item.parentJoint - 1 for index, item in enumerate(robot.collision_model.geometryObjects)}
    before_tool = joints[:-1] if len(joints) > 1 else joints  # The last joint is left out, because it moves the tool.
    if not np.isin(before_tool, list(of_body.values())).any():
        return "no link between its base and its tool has a collision shape"
    pairs = robot.collision_model.collisionPairs
    if not any(of_body[end] in joints for pair in pairs for end in (pair.first, pair.second)):
        return "no pair of its shapes is monitored"
    return None


def _named(links: list[str], in_cell: bool) -> str:
    return f"unchecked_links{': ' if in_cell else '='}[{', '.join(links if in_cell else map(repr, links))}]"
