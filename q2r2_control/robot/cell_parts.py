"""The models of which a cell is made, and the parts of them that belong to each arm."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from q2r2_control.config.arms import ArmConfig, FlangeConfig, PoseConfig, RobotConfig, ToolConfig
from q2r2_control.errors import AllFaults, ConfigError, Q2R2Error
from q2r2_control.robot.arm_chain import default_tip, end_of, named_joints
from q2r2_control.robot.description import (
    Description,
    LinkTree,
    joint_end,
    joint_limits,
    load_description,
    parse_srdf,
    read_xml,
)
from q2r2_control.robot.pairs import hand_links
from q2r2_control.robot.urdf_parts import WORLD, fixed_joint, renamed, renamed_exclusions


def cylinder_flange(thickness: float, radius: float, mass: float) -> Description:
    """Return the model of a flange: a cylinder on the arm's last link along z, with a link at its far end.

    Args:
        thickness: Length of the cylinder [m].
        radius: Radius of the cylinder [m].
        mass: Mass of the cylinder [kg].
    """
    across, along = mass * (3.0 * radius**2 + thickness**2) / 12.0, mass * radius**2 / 2.0
    moments = f'ixx="{across}" iyy="{across}" izz="{along}" ixy="0" ixz="0" iyz="0"'
    middle = f'<origin xyz="0 0 {thickness / 2}"/>'
    inertial = f'<inertial>{middle}<mass value="{mass}"/><inertia {moments}/></inertial>' if mass > 0.0 else ""
    shape = f'{middle}<geometry><cylinder radius="{radius}" length="{thickness}"/></geometry>'
    colour = '<material name="flange_body_colour"><color rgba="0.55 0.56 0.58 1"/></material>'
    urdf = ET.fromstring(
        f"""<robot name="flange"><link name="flange_body">{inertial}
        <visual name="flange_body_visual">{shape}{colour}</visual>
        <collision name="flange_body_collision">{shape}</collision></link><link name="flange_end"/></robot>"""
    )
    end = PoseConfig(position=(0.0, 0.0, thickness))
    urdf.append(fixed_joint("flange_end_mount", "flange_body", "flange_end", end))
    return Description(urdf=urdf, srdf=None, file=Path("flange"))


class Model:
    """One model in the cell. The names of its links and joints get a prefix."""

    def __init__(self, description: Description, prefix: str) -> None:
        self.description = description
        self.prefix = prefix
        self.parts = [part for part in description.urdf if part.tag in ("link", "joint", "material")]
        self.tree = LinkTree(description.urdf, str(description.file))
        self.links = [self.tree.root, *self.tree.joint_to]
        self.names = {part.get("name", "") for part in self.parts}
        self.exclusions = [] if description.srdf is None else [*description.srdf]

    def name_in_cell(self, name: str) -> str:
        # The root link of the cell already has the name WORLD, so a link with this name gets another name.
        return f"robot_{name}" if not self.prefix and name == WORLD else self.prefix + name

    def urdf(self, mount: PoseConfig) -> list[ET.Element]:
        """Return the links and joints with their names in the cell, and the joint that fixes the model at ``mount``."""
        joint = fixed_joint(f"{self.prefix or 'robot_'}mount", WORLD, self.name_in_cell(self.tree.root), mount)
        return [joint, *(renamed(part, self.name_in_cell) for part in self.parts)]


class Mounted(NamedTuple):
    """A flange or a tool on an arm."""

    model: Model
    joint: ET.Element  # The joint between this flange or tool and the part before it.
    # True if this part lies flat on the part before it. An SRDF may then exclude pairs between both parts.
    is_flat: bool


class ArmAssembly:
    """One arm of a model with flange and tool, with the joints and links that belong to it."""

    def __init__(self, config: ArmConfig, model: Model, packages: Mapping[str, str], side: str) -> None:
        self.config, self.model, self.key = config, model, f"arms.{side}"
        self.mounted: list[Mounted] = []
        self.frame = carrier = self._carrier()
        flat = False
        with suppress(ConfigError):
            flat = carrier == default_tip(model.tree, (), "")
        if (flange := load_flange(config.flange, packages, f"{self.key}.flange")) is not None:
            flat = flat and config.flange.model is not None
            self._mount(Model(flange, f"{side}_"), "flange", PoseConfig(), flat, config.flange.frame)
        if config.tool.model is None:
            if config.tool.frame is not None:
                _check_link(self.frame, model, f"{self.key}.tool.frame")
        else:
            tool = Model(load_model(config.tool, packages, f"{self.key}.tool"), f"{side}_")
            self._mount(tool, "tool", config.tool.mount, flat and config.tool.mount == PoseConfig(), config.tool.frame)
        whole = ET.Element("robot")
        whole.extend(model.parts)
        for mounted in self.mounted:
            whole.extend([*mounted.model.parts, mounted.joint])
        self.tree = LinkTree(whole, self.key)
        self.chain = self.tree.chain(self.frame)
        if not self.chain:
            named = "tip" if config.tip == self.frame else "tool.frame"
            no_arm = "no movable joint carries it; name a link that the arm moves"
            raise ConfigError(f"{self.key}.{named} = {self.frame!r:.60}: {no_arm}")
        self.joints = named_joints(self.tree, self.frame, config.joints, self.key)

    def _mount(self, part: Model, what: str, mount: PoseConfig, is_flat: bool, frame: str | None = None) -> None:
        """Put a flange or a tool on the end of the arm.

        The new end of the arm is the link ``frame`` of this part; if ``frame`` is None, it is the part's last link.
        """
        key = f"{self.key}.{what}"
        for other in (self.model, *(mounted.model for mounted in self.mounted)):
            for tag in ("link", "joint"):
                theirs, ours = (
                    {found.get("name", "") for found in one.parts if found.tag == tag} for one in (other, part)
                )
                if clash := theirs & ours:
                    name, names = part.description.name, ", ".join(sorted(clash))
                    raise ConfigError(f"{key}.model = {name!r}: {tag} names {names} occur in the arm as well")
        joint = fixed_joint(f"{what}_mount", self.frame, part.tree.root, mount)
        self.mounted.append(Mounted(part, joint, is_flat))
        self.frame = frame or end_of(part.tree, part.tree.root, f"{key}.frame")
        _check_link(self.frame, part, f"{key}.frame")

    def name_in_cell(self, name: str) -> str:
        for mounted in self.mounted:
            if name in mounted.model.names or name == mounted.joint.get("name"):
                return mounted.model.name_in_cell(name)
        return self.model.name_in_cell(name)

    def finger_names(self) -> tuple[str, ...]:
        """Return the joints that the gripper drives, with their names in the cell."""
        return tuple(map(self.name_in_cell, self.config.gripper.joints))

    def tool_links(self) -> tuple[str, ...]:
        """Return the links of the tool, with their names in the cell.

        Without a tool, these are the links of the hand, to which the gripper's joints are attached.
        """
        has_tool = self.config.tool.model is not None
        links = self.mounted[-1].model.links if has_tool else hand_links(self.tree, self.config.gripper.joints)
        return tuple(sorted(map(self.name_in_cell, links)))

    def leave_joints_of(self, others: Sequence[ArmAssembly]) -> None:
        """Remove joints that also move another arm, such as the joints of a torso, unless ``joints`` names them."""
        if self.config.joints:
            return
        for other in others:
            theirs = {joint.get("name") for joint in other.chain}
            self.joints = [joint for joint in self.joints if joint.get("name") not in theirs]
            if not self.joints:
                shared = f"every joint that carries {self.frame} carries {other.frame} of {other.key} as well"
                raise ConfigError(f"{self.key}: {shared}; name another tip")

    def mounted_urdf(self) -> list[ET.Element]:
        """Return the links and joints of flange and tool with their names in the cell."""
        return [renamed(part, self.name_in_cell) for item in self.mounted for part in [item.joint, *item.model.parts]]

    def mounted_exclusions(self) -> list[ET.Element]:
        """Return the excluded pairs of flange and tool: pairs within one part, and pairs with the parts before it."""
        parts, carriers = [], [self.model.description]
        for mounted in self.mounted:
            part = mounted.model.description
            parts += mounted.model.exclusions
            if mounted.is_flat:
                file = part.file.with_name(f"{name_of_stack([*carriers, part])}.srdf")
                parts += parse_srdf(read_xml(file), str(file)) if file.is_file() else []
            carriers.append(part)
        return renamed_exclusions(parts, self.name_in_cell)

    def acceleration_limits(self) -> dict[str, float]:
        """Return the acceleration limits that the configuration gives [rad/s^2], by the joints' names in the cell."""
        limits, names = self.config.acceleration_limit, [joint.get("name", "") for joint in self.joints]
        for name in limits:
            if name not in names:
                key, allowed = f"{self.key}.acceleration_limit.{name!s:.60}", ", ".join(names)
                raise ConfigError(f"{key}: no joint of the arm; allowed: {allowed}")
        return {self.name_in_cell(name): value for name, value in limits.items()}

    def posture(self) -> dict[str, float]:
        """Return the position of each joint of arm and gripper, with the arm at home and the gripper open [rad or m].

        The joints have the names of their models.
        """
        config, names = self.config, [joint.get("name", "") for joint in self.joints]
        if len(config.home) != len(names):
            others = [name for name in self._beyond() if name not in names]
            hint = f"; not the arm's unless joints names it: {', '.join(others[:4])}" if others else ""
            expected = f"{len(config.home)} value(s), expected {len(names)}: {', '.join(names)}{hint}"
            raise ConfigError(f"{self.key}.home = {list(config.home)}: {expected}")
        with AllFaults() as faults:
            for index, joint in enumerate(self.joints):
                with faults.of_part():
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
        """Return the last link of the arm in its own model."""
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
        """Return the movable joints beyond the last joint of the arm."""
        last = joint_end(self.chain[-1], "child")
        found = self.tree.movable().items()
        return [name for name, joint in found if last in self.tree.path(joint_end(joint, "parent"))]


def load_model(
    config: ArmConfig | RobotConfig | FlangeConfig | ToolConfig, packages: Mapping[str, str], key: str
) -> Description:
    """Return the description that the block ``key`` names. The text of a :class:`ConfigError` begins with ``key``."""
    model = config.model or ""
    try:
        return load_description(model, config.xacro_args, packages)
    except Q2R2Error as error:
        raise ConfigError(f"{key}.model = {model!r:.120}: {error}") from error


def load_flange(config: FlangeConfig, packages: Mapping[str, str], key: str) -> Description | None:
    """Return the flange of the block ``key``; None if the block has none.

    Raises :class:`ConfigError`, with a text that begins with ``key``, if the model cannot be used.
    """
    if config.thickness is not None and config.radius is not None:
        return cylinder_flange(config.thickness, config.radius, config.mass)
    return None if config.model is None else load_model(config, packages, key)


def name_of_stack(parts: Sequence[Description]) -> str:
    """Return the name, without .srdf, of the file with the excluded pairs of stacked ``parts``. The arm comes first."""
    return "_on_".join(part.stem for part in reversed(parts))


def check_position(joint: ET.Element, position: float, key: str) -> None:
    """Raise :class:`ConfigError` if ``position`` is outside the joint's limits. Its text begins with ``key``."""
    lower, upper = joint_limits(joint)
    if lower <= position <= upper:
        return
    unit = "m" if joint.get("type") == "prismatic" else "rad"
    radians = math.radians(position)
    # If a position is beyond half a turn [rad], but within the limits when it is read as degrees, it is most likely in
    # degrees.
    hint = f"; {position:g} degrees are {radians:.4g} rad" if unit == "rad" and abs(position) > math.pi else ""
    hint = hint if lower <= radians <= upper else ""
    raise ConfigError(f"{key} = {position:g}: joint {joint.get('name')} allows {lower:g} .. {upper:g} {unit}{hint}")


def _check_link(link: str, model: Model, key: str) -> None:
    if link not in model.links:
        name = model.description.name
        raise ConfigError(f"{key} = {link!r:.60}: {name} has no such link; allowed: {', '.join(model.links)}")
