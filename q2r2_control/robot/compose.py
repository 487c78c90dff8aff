"""Join arms, mounts, tools, obstacles and the floor into one URDF and one SRDF with the root link ``world``.

Names in an arm's own model and in its tool get the prefix ``left_`` or ``right_``. Names of obstacles, and of a
``robot`` of which the arms are parts, do not change. Joints that belong to no arm and no gripper are fixed.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from q2r2_control.config.arms import PoseConfig, check_models
from q2r2_control.config.cell import Config
from q2r2_control.errors import AllFaults, ConfigError
from q2r2_control.robot.cell_parts import ArmAssembly, Model, check_position, load_model
from q2r2_control.robot.description import LinkTree
from q2r2_control.robot.floor import FLOOR, floor_link
from q2r2_control.robot.followers import followers_of, with_followers
from q2r2_control.robot.pairs import KnownParts, exclusions_of_file, links_that_follow
from q2r2_control.robot.pinocchio_models import joint_origin, lock_joints, resting_position
from q2r2_control.robot.urdf_parts import (
    WORLD,
    fixed_joint,
    name_shapes,
    obstacle_link,
    renamed_exclusions,
    set_acceleration_limit,
    shape_from_drawings,
)
from q2r2_control.types import SIDES

_OBSTACLE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_RESERVED_NAME = re.compile(rf"({WORLD}|universe|({'|'.join(SIDES)})_)")


@dataclass(frozen=True, slots=True)
class ComposedCell:
    """One cell as text, and the names of its parts. Arms are in the order of ``Config.arms``."""

    name: str
    urdf: str
    srdf: str
    tool_frames: dict[str, str]  # For each arm, the link that the operator moves.
    home: dict[str, float]  # Position of every movable joint, with arms at home and grippers open.
    obstacles: tuple[str, ...]  # Names of the fixed obstacles, which are also the names of their links.
    parts: KnownParts  # The roles of links.

    def arm_lengths(self) -> dict[str, float]:
        """Return the length of each arm along its joints, from the first to the last [m]."""
        tree = LinkTree(ET.fromstring(self.urdf), self.name)
        lengths = {}
        for side, frame in self.tool_frames.items():
            joints = [tree.joint_to[link] for link in tree.path(frame)[1:]]
            moving = [index for index, joint in enumerate(joints) if joint.get("type") != "fixed"]
            between = joints[moving[0] + 1 : moving[-1] + 1]
            lengths[side] = sum(float(np.linalg.norm(joint_origin(joint).translation)) for joint in between)
        return lengths


def compose(config: Config) -> ComposedCell:
    """Build the cell of ``config``.

    Raises:
        ConfigError: If a model or link does not exist, if a home posture has the wrong length or is outside the limits,
            or if names clash or are reserved. The text names the key, the value and the allowed values.
    """
    if not config.name.isprintable():
        raise ConfigError(f"name = {config.name!r:.60}: allowed: printable characters")
    check_models(config.robot, config.arms)
    urdf, srdf = (ET.Element("robot", name=config.name) for _ in range(2))
    ET.SubElement(urdf, "link", name=WORLD)
    arms = _arms(config)
    for arm in arms.values():
        if arm is next(other for other in arms.values() if other.model is arm.model):
            urdf.extend(arm.model.urdf((config.robot or arm.config).mount))
            srdf.extend(renamed_exclusions(arm.model.exclusions, arm.model.name_in_cell))
        urdf.extend(arm.mounted_urdf())
        srdf.extend(arm.mounted_exclusions())
    _check_unique_names(urdf)
    home = _home(urdf, arms)
    of_arms = [arm.name_in_cell(joint.get("name", "")) for arm in arms.values() for joint in arm.joints]
    following = links_that_follow(LinkTree(urdf, config.name), of_arms)
    resting = {} if config.robot is None else config.robot.home
    _check_resting(urdf, resting, home)
    lock_joints(urdf, home, _locked_at(urdf, home | resting))
    for arm in arms.values():
        for name, limit in arm.acceleration_limits().items():
            set_acceleration_limit(next(joint for joint in urdf.findall("joint") if joint.get("name") == name), limit)
    shape_from_drawings(urdf.findall("link"), config.capsules)
    name_shapes(urdf.findall("link"))
    for name, obstacle in config.obstacles.items():
        _check_obstacle_name(name, urdf)
        placement = PoseConfig(position=obstacle.position, rpy=obstacle.rpy)
        urdf.extend([obstacle_link(name, obstacle), fixed_joint(f"{WORLD}_to_{name}", WORLD, name, placement)])
    if config.floor is not None:
        urdf.extend(floor_link(config.floor, WORLD, config.obstacles))
    if config.srdf is not None:
        srdf.extend(exclusions_of_file(config.srdf, {link.get("name", "") for link in urdf.findall("link")}))
    for tree in (urdf, srdf):
        ET.indent(tree)
    return ComposedCell(
        name=config.name,
        urdf=ET.tostring(urdf, encoding="unicode"),
        srdf=ET.tostring(srdf, encoding="unicode"),
        tool_frames={side: arm.name_in_cell(arm.frame) for side, arm in arms.items()},
        home=home,
        obstacles=tuple(config.obstacles),
        parts=KnownParts(
            finger_joints={side: arm.finger_names() for side, arm in arms.items()},
            strokes={
                side: (arm.config.gripper.closed_position, arm.config.gripper.open_position)
                for side, arm in arms.items()
                if arm.config.gripper.joints
            },
            tool_links={side: arm.tool_links() for side, arm in arms.items()},
            obstacles=(*config.obstacles, *([] if config.floor is None else [FLOOR])),
            capsules=config.capsules,
            following=following,
        ),
    )


def _arms(config: Config) -> dict[str, ArmAssembly]:
    """Return every arm of the cell with its own joints."""
    robot = None if config.robot is None else Model(load_model(config.robot, config.packages, "robot"), "")
    arms: dict[str, ArmAssembly] = {}
    with AllFaults() as faults:
        for side in (side for side in SIDES if side in config.arms):
            with faults.of_part():
                made = config.arms[side]
                model = robot or Model(load_model(made, config.packages, f"arms.{side}"), f"{side}_")
                arms[side] = ArmAssembly(made, model, config.packages, side)
    for arm in arms.values():
        arm.leave_joints_of([other for other in arms.values() if other is not arm and other.model is arm.model])
    return arms


def _home(urdf: ET.Element, arms: Mapping[str, ArmAssembly]) -> dict[str, float]:
    """Return the home position of every joint that an arm or a gripper moves [rad or m], by the name in the cell.

    Joints that mimic a finger's joint are included.
    """
    home: dict[str, float] = {}
    owner: dict[str, str] = {}
    fingers: set[str] = set()
    with AllFaults() as faults:
        postures = {}
        for side, arm in arms.items():
            with faults.of_part():
                postures[side] = arm.posture()
    for side, arm in arms.items():
        for joint, position in postures[side].items():
            name = arm.name_in_cell(joint)
            if name in home:
                raise ConfigError(f"{arm.key}: joint {name} is one of {owner[name]} as well; allowed: one arm a joint")
            home[name], owner[name] = position, arm.key
        fingers |= set(arm.finger_names())
    followers = followers_of(urdf.findall("joint"), driven=home)
    return with_followers(home, {name: one for name, one in followers.items() if one.driver in fingers})


def _check_resting(urdf: ET.Element, resting: Mapping[str, float], home: Mapping[str, float]) -> None:
    joints = {joint.get("name", ""): joint for joint in urdf.findall("joint") if joint.get("type") != "fixed"}
    with AllFaults() as faults:
        for name, position in resting.items():
            with faults.of_part():
                if name not in joints or name in home:
                    allowed = ", ".join(joint for joint in joints if joint not in home)
                    raise ConfigError(f"robot.home.{name!s:.60}: no joint that rests; allowed: {allowed or 'none'}")
                check_position(joints[name], position, f"robot.home.{name}")


def _locked_at(urdf: ET.Element, given: Mapping[str, float]) -> dict[str, float]:
    """Return the position of every joint [rad or m].

    It is the position in ``given``, or the position that the joint's ``<mimic>`` demands, or else the position nearest
    to 0 within the limits.
    """
    joints = urdf.findall("joint")
    followers = followers_of(joints, driven=given)
    resting = {name: resting_position(joint) for joint in joints if (name := joint.get("name", "")) not in followers}
    return with_followers(resting | dict(given), followers)


def _check_unique_names(urdf: ET.Element) -> None:
    """Check that no link or joint name occurs twice.

    A name in ``robot``, which gets no prefix, may be the same as a tool's name with its prefix.
    """
    for tag in ("link", "joint"):
        names = [element.get("name", "") for element in urdf.findall(tag)]
        if twice := sorted(name for name in set(names) if names.count(name) > 1):
            raise ConfigError(f"robot.model: its {tag} {twice[0]} has the name of another one in the cell")


def _check_obstacle_name(name: str, urdf: ET.Element) -> None:
    if not _OBSTACLE_NAME.fullmatch(name) or _RESERVED_NAME.match(name):
        reserved = f"{WORLD}, universe, {', '.join(f'{side}_' for side in SIDES)}"
        letters = "letters, digits and _, starting with a letter"
        raise ConfigError(f"obstacles.{name!r:.60}: allowed: {letters}, and not with {reserved}")
    if urdf.find(f"link[@name='{name}']") is not None:
        raise ConfigError(f"obstacles.{name}: the cell has a link of this name; allowed: another name")
