"""Joins arms, mounts, tools, obstacles and the floor into one URDF and one SRDF under the root link ``world``.

The one text feeds Pinocchio, MuJoCo, viewers and ``robot_description``. Names of an arm and its tool get the prefix
``left_`` or ``right_``; obstacles keep theirs.
"""

from __future__ import annotations

import copy
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from q2r2_control.config.cell import ArmConfig, Config, ObstacleConfig, PoseConfig
from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.robot.description import Description, LinkTree, joint_limits, load_description, parse_srdf
from q2r2_control.robot.floor import floor_link
from q2r2_control.robot.pairs import exclusions_of_file
from q2r2_control.types import SIDES

WORLD = "world"

# Elements that name links or joints, and the attribute that does.
_NAMING = {"parent": "link", "child": "link", "mimic": "joint"}
_OBSTACLE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
_RESERVED_NAME = re.compile(rf"({WORLD}|universe|({'|'.join(SIDES)})_)")


@dataclass(frozen=True, slots=True)
class ComposedCell:
    """One cell as text, and what its parts are called in it. Arms by side, in the order of ``Config.arms``."""

    name: str
    urdf: str
    srdf: str
    tool_frames: dict[str, str]  # link that the operator moves
    arm_joints: dict[str, tuple[str, ...]]  # movable joints from the world to the tool frame, in that order
    finger_joints: dict[str, tuple[str, ...]]  # joints that the gripper drives
    home: dict[str, float]  # every movable joint's position: arms at home, grippers open, others as near 0 as allowed
    obstacles: tuple[str, ...]  # link names


@dataclass(frozen=True, slots=True)
class _Arm:
    urdf: list[ET.Element]  # prefixed links, joints, materials
    srdf: list[ET.Element]
    tool_frame: str
    joints: tuple[str, ...]
    fingers: tuple[str, ...]
    home: dict[str, float]


def compose(config: Config) -> ComposedCell:
    """Build the cell of ``config``.

    Raises :class:`ConfigError` that names key, value and what is allowed: a model or link that does not exist, a home
    posture of the wrong length or outside the limits, clashing or reserved names.
    """
    if not config.name.isprintable():
        raise ConfigError(f"name = {config.name!r:.60}: allowed: printable characters")
    urdf = ET.Element("robot", name=config.name)
    srdf = ET.Element("robot", name=config.name)
    ET.SubElement(urdf, "link", name=WORLD)
    arms = {side: _compose_arm(side, config.arms[side]) for side in SIDES if side in config.arms}
    for arm in arms.values():
        urdf.extend(arm.urdf)
        srdf.extend(arm.srdf)
    for name, obstacle in config.obstacles.items():
        _check_obstacle_name(name)
        urdf.extend(_obstacle(name, obstacle))
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
        tool_frames={side: arm.tool_frame for side, arm in arms.items()},
        arm_joints={side: arm.joints for side, arm in arms.items()},
        finger_joints={side: arm.fingers for side, arm in arms.items()},
        home={joint: position for arm in arms.values() for joint, position in arm.home.items()},
        obstacles=tuple(config.obstacles),
    )


def _compose_arm(side: str, config: ArmConfig) -> _Arm:
    key, prefix = f"arms.{side}", f"{side}_"
    robot, srdf, frame = _arm_with_tool(config, key)
    tree = LinkTree(robot, key)
    chain = tree.chain(frame)
    if not chain:
        raise ConfigError(
            f"{key}.tool.frame = {frame!r:.60}: no movable joint carries it; name a link that the arm moves"
        )
    home = _posture(robot, chain, config, key)
    parts = [_prefixed(part, prefix) for part in robot]
    _name_shapes(parts)
    mount = _fixed_joint(f"{prefix}mount", WORLD, prefix + tree.root, config.mount)
    return _Arm(
        urdf=[mount, *parts],
        srdf=[exclusion for part in srdf for exclusion in _prefixed_exclusion(part, prefix)],
        tool_frame=prefix + frame,
        joints=tuple(prefix + joint.get("name", "") for joint in chain),
        fingers=tuple(prefix + joint for joint in config.gripper.joints),
        home={prefix + joint: position for joint, position in home.items()},
    )


def _arm_with_tool(config: ArmConfig, key: str) -> tuple[ET.Element, list[ET.Element], str]:
    """URDF of an arm with its tool, the exclusions of both, and the link that the operator moves; nothing prefixed."""
    arm = _load(config.model, f"{key}.model")
    tree = LinkTree(arm.urdf, config.model)
    carrier = config.tool.link or _last_link(tree)
    _check_link(carrier, tree, config.model, f"{key}.tool.link")
    parts, srdf = [*arm.urdf], _children(arm.srdf)
    if config.tool.model is None:
        frame = config.tool.frame or carrier
        _check_link(frame, tree, config.model, f"{key}.tool.frame")
    else:
        tool = _load(config.tool.model, f"{key}.tool.model")
        _check_clash(arm, tool, f"{key}.tool.model")
        tool_tree = LinkTree(tool.urdf, config.tool.model)
        parts += [*tool.urdf, _fixed_joint("tool_mount", carrier, tool_tree.root, config.tool.mount)]
        srdf += _children(tool.srdf)
        if carrier == _last_link(tree) and config.tool.mount == PoseConfig():
            srdf += _exclusions_of_the_two(arm, tool)
        frame = config.tool.frame or _last_link(tool_tree)
        _check_link(frame, tool_tree, config.tool.model, f"{key}.tool.frame")
    robot = ET.Element("robot")
    robot.extend(part for part in parts if part.tag in ("link", "joint", "material"))
    return robot, srdf, frame


def _children(element: ET.Element | None) -> list[ET.Element]:
    return [] if element is None else [*element]


def _load(model: str, key: str) -> Description:
    try:
        return load_description(model)
    except Q2R2Error as error:
        raise ConfigError(f"{key} = {model!r:.120}: {error}") from error


def _last_link(tree: LinkTree) -> str:
    """The link furthest down before the movable joints branch: a flange, or a gripper without its fingers."""
    links = [tree.root, *tree.joint_to]
    depth = 0
    while True:
        rigid = [link for link in links if len(tree.chain(link)) == depth]
        if (
            sum(len(tree.chain(link)) == depth + 1 and tree.joint_to[link].get("type") != "fixed" for link in links)
            != 1
        ):
            return min(rigid, key=lambda link: (-len(tree.path(link)), link))
        depth += 1


def _check_link(link: str, tree: LinkTree, model: str, key: str) -> None:
    links = [tree.root, *tree.joint_to]
    if link not in links:
        raise ConfigError(f"{key} = {link!r:.60}: {model} has no such link; allowed: {', '.join(links)}")


def _check_clash(arm: Description, tool: Description, key: str) -> None:
    for tag in ("link", "joint"):
        names = {element.get("name", "") for element in arm.urdf.findall(tag)}
        clash = names & {element.get("name", "") for element in tool.urdf.findall(tag)}
        if clash:
            raise ConfigError(f"{key} = {tool.name!r}: {tag} names {', '.join(sorted(clash))} occur in the arm as well")


def _exclusions_of_the_two(arm: Description, tool: Description) -> list[ET.Element]:
    """Pairs known of just this tool flat on just this arm's last link: ``TOOL_on_ARM.srdf`` beside the tool."""
    file = tool.file.with_name(f"{tool.file.stem}_on_{arm.file.stem}.srdf")
    return [*parse_srdf(file.read_text(encoding="utf-8"), str(file))] if file.is_file() else []


def _posture(robot: ET.Element, chain: list[ET.Element], config: ArmConfig, key: str) -> dict[str, float]:
    """Position of every movable joint: arm at home, fingers open, others as near zero as their limits allow."""
    names = [joint.get("name", "") for joint in chain]
    if len(config.home) != len(names):
        raise ConfigError(
            f"{key}.home = {list(config.home)}: {len(config.home)} value(s), expected {len(names)}: {', '.join(names)}"
        )
    movable = {joint.get("name", ""): joint for joint in robot.findall("joint") if joint.get("type") != "fixed"}
    posture = {name: min(max(0.0, joint_limits(joint)[0]), joint_limits(joint)[1]) for name, joint in movable.items()}
    for index, (joint, position) in enumerate(zip(chain, config.home, strict=True)):
        _check_position(joint, position, f"{key}.home[{index}]")
        posture[names[index]] = position
    for finger in config.gripper.joints:
        free = [name for name in movable if name not in names]
        if finger not in free:
            allowed = ", ".join(free) or "none: the model has no joints beside the arm's"
            raise ConfigError(f"{key}.gripper.joints = {finger!r:.60}: no such finger joint; allowed: {allowed}")
        for end in ("open_position", "closed_position"):
            _check_position(movable[finger], getattr(config.gripper, end), f"{key}.gripper.{end}")
        posture[finger] = config.gripper.open_position
    return posture


def _check_position(joint: ET.Element, position: float, key: str) -> None:
    lower, upper = joint_limits(joint)
    if not lower <= position <= upper:
        raise ConfigError(f"{key} = {position:g}: joint {joint.get('name')} allows {lower:g} .. {upper:g}")


def _prefixed(part: ET.Element, prefix: str) -> ET.Element:
    """A copy of a link, joint or material with every name in it prefixed."""
    part = copy.deepcopy(part)
    for element in part.iter():
        if element.tag in _NAMING:
            attribute = _NAMING[element.tag]
            element.set(attribute, prefix + element.get(attribute, ""))
        elif element.get("name"):
            element.set("name", prefix + element.get("name", ""))
    return part


def _name_shapes(links: Sequence[ET.Element]) -> None:
    """Give every shape a name of its own, which MuJoCo needs; shapes that share one or have none get their link's."""
    for tag in ("collision", "visual"):
        used = Counter(shape.get("name") for link in links for shape in link.findall(tag))
        for link in links:
            for index, shape in enumerate(link.findall(tag)):
                if not shape.get("name") or used[shape.get("name")] > 1:
                    shape.set("name", f"{link.get('name')}_{tag}_{index}")


def _prefixed_exclusion(part: ET.Element, prefix: str) -> list[ET.Element]:
    attributes = {"disable_collisions": ("link1", "link2"), "disable_default_collisions": ("link",)}.get(part.tag)
    if attributes is None:
        return []
    part = copy.deepcopy(part)
    for attribute in attributes:
        part.set(attribute, prefix + part.get(attribute, ""))
    return [part]


def _check_obstacle_name(name: str) -> None:
    if not _OBSTACLE_NAME.fullmatch(name) or _RESERVED_NAME.match(name):
        raise ConfigError(
            f"obstacles.{name!r:.60}: allowed: letters, digits and _, starting with a letter, "
            f"and not with {WORLD}, universe, {', '.join(f'{side}_' for side in SIDES)}"
        )


def _obstacle(name: str, config: ObstacleConfig) -> list[ET.Element]:
    link = ET.Element("link", name=name)
    for tag in ("visual", "collision"):
        shape = ET.SubElement(link, tag, name=f"{name}_{tag}")
        shape.append(_shape(config))
        if tag == "visual":
            material = ET.SubElement(shape, "material", name=f"{name}_colour")
            ET.SubElement(material, "color", rgba=_numbers(config.colour))
    if config.shape == "capsule":
        checking = ET.SubElement(link, "collision_checking")
        ET.SubElement(checking, "capsule", name=f"{name}_collision")
    pose = PoseConfig(position=config.position, rpy=config.rpy)
    return [link, _fixed_joint(f"{WORLD}_to_{name}", WORLD, name, pose)]


def _shape(config: ObstacleConfig) -> ET.Element:
    geometry = ET.Element("geometry")
    if config.shape == "box":
        ET.SubElement(geometry, "box", size=_numbers(config.size))
    elif config.shape == "sphere":
        ET.SubElement(geometry, "sphere", radius=_numbers(config.size))
    else:
        radius, length = config.size
        ET.SubElement(geometry, "cylinder", radius=_numbers([radius]), length=_numbers([length]))
    return geometry


def _fixed_joint(name: str, parent: str, child: str, pose: PoseConfig) -> ET.Element:
    joint = ET.Element("joint", name=name, type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    ET.SubElement(joint, "origin", xyz=_numbers(pose.position), rpy=_numbers(pose.rpy))
    return joint


def _numbers(values: Sequence[float]) -> str:
    return " ".join(repr(float(value)) for value in values)
