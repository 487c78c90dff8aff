"""The models that a cell is made of, and each arm's part in them."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence

from q2r2_control.config.arms import ArmConfig, PoseConfig, RobotConfig, ToolConfig
from q2r2_control.errors import ConfigError, Q2R2Error
from q2r2_control.robot.arm_chain import default_tip, end_of, named_joints
from q2r2_control.robot.description import Description, LinkTree, joint_end, joint_limits, load_description, parse_srdf
from q2r2_control.robot.link_roles import hand_links
from q2r2_control.robot.urdf_parts import WORLD, fixed_joint, renamed, renamed_exclusions


class Model:
    """One model of the cell, whose names get a prefix."""

    def __init__(self, description: Description, prefix: str) -> None:
        self.description = description
        self.prefix = prefix
        self.parts = [part for part in description.urdf if part.tag in ("link", "joint", "material")]
        self.tree = LinkTree(description.urdf, str(description.file))
        self.links = [self.tree.root, *self.tree.joint_to]
        self.names = {part.get("name", "") for part in self.parts}
        self.exclusions = [] if description.srdf is None else [*description.srdf]

    def name_in_cell(self, name: str) -> str:
        # The cell has a link of this name already: a model's own root.
        return f"robot_{name}" if not self.prefix and name == WORLD else self.prefix + name

    def urdf(self, mount: PoseConfig) -> list[ET.Element]:
        """What goes into the cell."""
        joint = fixed_joint(f"{self.prefix or 'robot_'}mount", WORLD, self.name_in_cell(self.tree.root), mount)
        return [joint, *(renamed(part, self.name_in_cell) for part in self.parts)]


class Arm:
    """One arm of a model with its tool, and which joints and links of the two are the arm's."""

    def __init__(self, config: ArmConfig, model: Model, packages: Mapping[str, str], side: str) -> None:
        self.config, self.model, self.key = config, model, f"arms.{side}"
        self.tool: Model | None = None
        carrier = self._carrier()
        self.tree, self.frame = model.tree, config.tool.frame or carrier
        if config.tool.model is None:
            _check_link(self.frame, model, f"{self.key}.tool.frame")
        else:
            tool_key = f"{self.key}.tool"
            self.tool = Model(load_model(config.tool, packages, tool_key), f"{side}_")
            _check_clash(model, self.tool, f"{tool_key}.model")
            self.frame = config.tool.frame or end_of(self.tool.tree, self.tool.tree.root, f"{tool_key}.frame")
            _check_link(self.frame, self.tool, f"{tool_key}.frame")
            self.tool_joint = fixed_joint("tool_mount", carrier, self.tool.tree.root, config.tool.mount)
            whole = ET.Element("robot")
            whole.extend([*model.parts, *self.tool.parts, self.tool_joint])
            self.tree = LinkTree(whole, self.key)
        self.carrier = carrier
        self.chain = self.tree.chain(self.frame)
        if not self.chain:
            named = "tip" if config.tip == self.frame else "tool.frame"
            raise ConfigError(
                f"{self.key}.{named} = {self.frame!r:.60}: no movable joint carries it; name a link that the arm moves"
            )
        self.joints = named_joints(self.tree, self.frame, config.joints, self.key)

    def name_in_cell(self, name: str) -> str:
        of_tool = self.tool is not None and (name in self.tool.names or name == "tool_mount")
        return (self.tool if of_tool and self.tool is not None else self.model).name_in_cell(name)

    def joint_names(self) -> tuple[str, ...]:
        """The arm's own joints, as they are called in the cell."""
        return tuple(self.name_in_cell(joint.get("name", "")) for joint in self.joints)

    def finger_names(self) -> tuple[str, ...]:
        """The joints that the gripper drives, as they are called in the cell."""
        return tuple(map(self.name_in_cell, self.config.gripper.joints))

    def tool_links(self) -> tuple[str, ...]:
        """The links of the tool, or else of the hand that carries the gripper's joints, as they are in the cell."""
        links = self.tool.links if self.tool is not None else sorted(hand_links(self.tree, self.config.gripper.joints))
        return tuple(map(self.name_in_cell, links))

    def leave_joints_of(self, others: Sequence[Arm]) -> None:
        """Give up joints that carry another arm of the model too, such as a torso's, unless ``joints`` names them."""
        if self.config.joints:
            return
        for other in others:
            theirs = {joint.get("name") for joint in other.chain}
            self.joints = [joint for joint in self.joints if joint.get("name") not in theirs]
            if not self.joints:
                raise ConfigError(
                    f"{self.key}: every joint that carries {self.frame} carries {other.frame} of {other.key} as well; "
                    "name another tip"
                )

    def tool_urdf(self) -> list[ET.Element]:
        """What the tool adds to the cell."""
        if self.tool is None:
            return []
        return [renamed(part, self.name_in_cell) for part in [self.tool_joint, *self.tool.parts]]

    def tool_exclusions(self) -> list[ET.Element]:
        """Pairs of the tool's links, and of those of the tool flat on just this model's tip."""
        if self.tool is None:
            return []
        parts = list(self.tool.exclusions)
        if self.config.tool.mount == PoseConfig() and self.carrier == _usual_tip(self.model.tree):
            parts += _exclusions_of_the_two(self.model.description, self.tool.description)
        return renamed_exclusions(parts, self.name_in_cell)

    def posture(self) -> dict[str, float]:
        """Position of each joint of arm and gripper: the arm at home, the gripper open."""
        config, names = self.config, [joint.get("name", "") for joint in self.joints]
        if len(config.home) != len(names):
            others = [name for name in self._beyond() if name not in names]
            hint = f"; not the arm's unless joints names it: {', '.join(others[:4])}" if others else ""
            raise ConfigError(
                f"{self.key}.home = {list(config.home)}: {len(config.home)} value(s), expected {len(names)}: "
                f"{', '.join(names)}{hint}"
            )
        for index, joint in enumerate(self.joints):
            check_position(joint, config.home[index], f"{self.key}.home[{index}]")
        return dict(zip(names, config.home, strict=True)) | self._open_gripper()

    def _open_gripper(self) -> dict[str, float]:
        gripper, key = self.config.gripper, f"{self.key}.gripper"
        carrying = {joint.get("name", "") for joint in self.chain}
        free = {name: self.tree.movable()[name] for name in self._beyond() if name not in carrying}
        for finger in gripper.joints:
            if finger not in free:
                allowed = ", ".join(free) or "none: the arm carries no joints"
                raise ConfigError(f"{key}.joints = {finger!r:.60}: no such finger joint; allowed: {allowed}")
            check_position(free[finger], gripper.open_position, f"{key}.open_position")
            check_position(free[finger], gripper.closed_position, f"{key}.closed_position")
        return dict.fromkeys(gripper.joints, gripper.open_position)

    def _carrier(self) -> str:
        """The arm's last link, of those of its model."""
        config, tree = self.config, self.model.tree
        if (named := config.named_tip) is not None:
            _check_link(named, self.model, f"{self.key}.{'tip' if config.tip else 'tool.link'}")
            return named
        if config.tool.model is None and config.tool.frame is not None:
            return config.tool.frame
        if config.joints:
            last = config.joints[-1]
            if last not in tree.movable():
                allowed = ", ".join(tree.movable())
                raise ConfigError(f"{self.key}.joints = {last!r:.60}: no such joint; allowed: {allowed}")
            return end_of(tree, joint_end(tree.movable()[last], "child"), f"{self.key}.tip")
        return default_tip(tree, config.gripper.joints, f"{self.key}.tip")

    def _beyond(self) -> list[str]:
        """Movable joints that the arm's last one carries."""
        last = joint_end(self.chain[-1], "child")
        found = self.tree.movable().items()
        return [name for name, joint in found if last in self.tree.path(joint_end(joint, "parent"))]


def load_model(config: ArmConfig | RobotConfig | ToolConfig, packages: Mapping[str, str], key: str) -> Description:
    """The description that the block ``key`` names. Raises :class:`ConfigError` that begins with it."""
    model = config.model or ""
    try:
        return load_description(model, config.xacro_args, packages)
    except Q2R2Error as error:
        raise ConfigError(f"{key}.model = {model!r:.120}: {error}") from error


def check_position(joint: ET.Element, position: float, key: str) -> None:
    """Raise :class:`ConfigError` that begins with ``key`` where ``position`` is outside the joint's limits."""
    lower, upper = joint_limits(joint)
    if not lower <= position <= upper:
        raise ConfigError(f"{key} = {position:g}: joint {joint.get('name')} allows {lower:g} .. {upper:g}")


def _check_link(link: str, model: Model, key: str) -> None:
    if link not in model.links:
        name = model.description.name
        raise ConfigError(f"{key} = {link!r:.60}: {name} has no such link; allowed: {', '.join(model.links)}")


def _check_clash(arm: Model, tool: Model, key: str) -> None:
    for tag in ("link", "joint"):
        names = {part.get("name", "") for part in arm.parts if part.tag == tag}
        if clash := names & {part.get("name", "") for part in tool.parts if part.tag == tag}:
            tools = tool.description.name
            raise ConfigError(f"{key} = {tools!r}: {tag} names {', '.join(sorted(clash))} occur in the arm as well")


def _usual_tip(tree: LinkTree) -> str | None:
    try:
        return default_tip(tree, (), "")
    except ConfigError:
        return None


def _exclusions_of_the_two(arm: Description, tool: Description) -> list[ET.Element]:
    """Pairs known of just this tool flat on just this arm's last link: ``TOOL_on_ARM.srdf`` beside the tool."""
    file = tool.file.with_name(f"{tool.stem}_on_{arm.stem}.srdf")
    return [*parse_srdf(file.read_text(encoding="utf-8"), str(file))] if file.is_file() else []
