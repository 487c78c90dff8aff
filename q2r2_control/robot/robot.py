"""The robot as the controller sees it: a Pinocchio model, monitored collision pairs, arms and limits."""

from __future__ import annotations

import logging
import os
import xml.etree.ElementTree as ET
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.config.arms import HeldObjectConfig
from q2r2_control.config.cell import Config
from q2r2_control.errors import AllFaults, ConfigError, RobotError, check_kind, shown
from q2r2_control.robot.cell_parts import check_position
from q2r2_control.robot.coal_distances import CoalDistances
from q2r2_control.robot.compose import compose
from q2r2_control.robot.description import LinkTree, joint_limits, parse_srdf, parse_urdf
from q2r2_control.robot.enclose import enclose_shapes
from q2r2_control.robot.finger_bodies import sweep_fingers
from q2r2_control.robot.floor import remove_unreachable_floor_pairs, sink_boxes_into_floor
from q2r2_control.robot.followers import followers_of, with_followers
from q2r2_control.robot.held_objects import HeldObjects, held_objects
from q2r2_control.robot.near_pairs import warning_at_home
from q2r2_control.robot.pairs import (
    KnownParts,
    LinkClass,
    Role,
    add_movable_pairs,
    pair_names,
    remove_disabled_pairs,
    remove_overlapping_own_pairs,
    roles_of,
)
from q2r2_control.robot.pinocchio_models import build_models, checked_chain
from q2r2_control.robot.turning_fingers import TurningBody
from q2r2_control.robot.unchecked import check_watched
from q2r2_control.robot.urdf_parts import CONTINUOUS_RANGE, acceleration_limit
from q2r2_control.types import Array

_logger = logging.getLogger(__name__)
_SAME_FRAME = 1e-3  # Greatest difference between two frames that count as the same frame [m], [rad].


@dataclass(frozen=True, slots=True)
class Arm:
    """One arm: the frame that the operator moves, and the joints that move it."""

    name: str
    tool_frame: str  # Name of the link.
    frame_id: int  # Number of the tool frame in ``Robot.model``.
    joints: np.ndarray  # Velocity indices from base to tool. A joint that moves several arms belongs to each of them.
    finger_joints: tuple[str, ...] = ()  # The joints that its gripper drives.
    stroke: float = 0.0  # Travel of each finger joint from closed to open [m or rad]; 0 if it is not known.
    finger_way: float = 0.0  # Distance by which the stroke moves a finger [m]; 0 if it is not known.


@dataclass(frozen=True, slots=True)
class PairDistance:
    """The distance of one monitored pair."""

    name_a: str
    name_b: str
    distance: float  # [m]. A negative distance is a penetration depth.


class Robot:
    """Kinematics, dynamics and collision model of a cell, reduced to the joints that move a tool.

    Make it by :meth:`from_config` or :meth:`from_urdf`. All arrays are (nv,) in the order of ``model``'s velocity,
    which is the order of ``joint_names``. Positions are in [rad], velocities in [rad/s] and torques in [Nm]; for
    prismatic joints they are in [m], [m/s] and [N]. ``acceleration_limit`` is infinite for joints without such a limit
    in the model. :meth:`capped_acceleration` returns the limits that a controller uses.

    ``collision_model`` contains exactly the monitored pairs. Each arm has pairs with the other arm and that arm's base,
    with its own links that it can meet, and with obstacles. Every monitored shape is a capsule, a sphere, or a box
    fixed in the world. The body of a finger is the volume that it sweeps. ``finger_bodies`` compute the smaller bodies
    that replace such bodies while a gripper's opening is known. ``objects`` are the objects that grippers hold, in
    addition to the collision model. ``ignored_pairs`` are pairs of one arm's shapes that overlap by construction.

    Attributes:
        name: Name of the URDF.
        model: ``pinocchio.Model`` of the joints that move a tool. With data of its own, ``robot.model.createData()``, a
            task or a constraint computes Jacobians by Pinocchio: ``pinocchio.computeFrameJacobian(robot.model, data,
            q, robot.arms["left"].frame_id, pinocchio.LOCAL_WORLD_ALIGNED)``, (6, nv), first linear, then angular.
        joint_names: Names in the order of every array of joints.
        arms: Arms by name. ``tool_frame`` is the name of the tool's link, and ``frame_id`` is its number in ``model``.
            ``joints`` are the indices of the arm's joints in arrays of joints, from base to tool.
        home: Joint positions at which the cell starts (nv,) [rad].
        position_lower: The model's lower position limits (nv,) [rad].
        position_upper: The model's upper position limits (nv,) [rad].
        endless: True for each continuous joint, which turns without end (nv,).
        velocity_limit: The model's velocity limits (nv,) [rad/s].
        torque_limit: The model's torque limits (nv,) [Nm].
        following_links: For each link beside an arm that follows the arm, the joint of the arm that it follows. Such a
            link is watched only at its pose at home.
        unchecked_links: Names of links without a collision shape, which by the user's choice are not watched.
    """

    def __new__(cls, urdf: ET.Element | None = None, *_: object, **__: object) -> Self:
        """Refuse a first argument that is no parsed URDF, before Python complains about missing arguments.

        The error then names the right constructors. When Python copies a robot, it calls this method without arguments.
        """
        if not isinstance(urdf, ET.Element | None):
            raise RobotError(
                f"Robot({shown(urdf)}, ...): allowed: Robot.from_config(config), Robot.from_urdf(file, ...)"
            )
        return super().__new__(cls)

    def __init__(
        self,
        urdf: ET.Element,
        exclusions: Iterable[ET.Element] | None,
        tool_frames: Mapping[str, str],
        home: Mapping[str, float],
        where: str,
        parts: KnownParts | None = None,
        unchecked_links: Collection[str] = (),
    ) -> None:
        tree = LinkTree(urdf, where)
        chains = {name: checked_chain(tree, name, frame, where) for name, frame in tool_frames.items()}
        parts = parts or KnownParts.carried_by(tree, chains)
        self.name: str = urdf.get("name", "robot")
        self._urdf = urdf
        self.model, self.collision_model = build_models(urdf, chains, home, where)
        self.joint_names: tuple[str, ...] = tuple(self.model.names)[1:]
        self.arms: dict[str, Arm] = {
            name: Arm(
                name=name,
                tool_frame=frame,
                frame_id=int(self.model.getFrameId(frame, pin.FrameType.BODY)),
                joints=np.array([self.model.joints[self.model.getJointId(joint)].idx_v for joint in chains[name]]),
                finger_joints=parts.finger_joints.get(name, ()),
                stroke=abs(float(np.subtract(*parts.strokes.get(name, (0.0, 0.0))))),
            )
            for name, frame in tool_frames.items()
        }
        self.home: Array = np.array([home[joint] for joint in self.joint_names])
        self.position_lower: Array = self.model.lowerPositionLimit.copy()
        self.position_upper: Array = self.model.upperPositionLimit.copy()
        # A continuous joint is recognised by the range that description.parse_urdf gives to joints without limits.
        self.endless = (self.position_lower <= -CONTINUOUS_RANGE) & (self.position_upper >= CONTINUOUS_RANGE)
        self.velocity_limit: Array = self.model.velocityLimit.copy()
        self.torque_limit: Array = self.model.effortLimit.copy()
        joints = {joint.get("name", ""): joint for joint in urdf.findall("joint")}
        self.acceleration_limit: Array = np.array([acceleration_limit(joints[name]) for name in self.joint_names])
        # The links of an arm are the links from the root to the tool, and the links of branches beside this path, such
        # as fingers.
        bodies = [frame for frame in self.model.frames if frame.type == pin.FrameType.BODY]
        own_links = {
            name: {*tree.path(arm.tool_frame), *(body.name for body in bodies if body.parentJoint - 1 in arm.joints)}
            for name, arm in self.arms.items()
        }
        self.roles: dict[str, Role] = roles_of(tree, own_links, parts)
        enclose_shapes(self.collision_model, parts.capsules)
        self.finger_bodies = sweep_fingers(self.model, self.collision_model, tree, parts, home)
        for name, arm in self.arms.items():
            ways = [body.way for body in self.finger_bodies if isinstance(body, TurningBody) and body.arm == name]
            self.arms[name] = replace(arm, finger_way=max(ways, default=0.0) or arm.stroke)
        self.ignored_pairs = self._monitor(tree, exclusions, list(own_links.values()))
        self.objects = HeldObjects(self.collision_model, {}, ())
        self.following_links: dict[str, str] = dict(parts.following)
        self.unchecked_links: tuple[str, ...] = tuple(unchecked_links)
        for link in self.unchecked_links:
            if link != tree.root and link not in tree.joint_to:
                links = ", ".join([tree.root, *tree.joint_to])
                raise RobotError(f"{where}: unchecked_links: no link {link!r:.60}; links: {links}")
        self._data: pin.Data = self.model.createData()
        self._distances = CoalDistances(self.model, self.collision_model)

    @cached_property
    def urdf(self) -> str:
        """The whole cell as a text."""
        return ET.tostring(self._urdf, encoding="unicode")

    @classmethod
    def from_config(cls, config: Config) -> Robot:
        """Return the robot of a cell.

        Raises:
            ConfigError: If the configuration cannot be used. The text says what is wrong and where.
            RobotError: If a model cannot be used. The text says what is wrong and where.
        """
        check_kind("config", config, Config, "a Config, as load_config returns")
        cell = compose(config)
        urdf = parse_urdf(cell.urdf, cell.name)
        exclusions, unchecked = parse_srdf(cell.srdf, cell.name), config.unchecked_links
        robot = cls(urdf, exclusions, cell.tool_frames, cell.home, cell.name, cell.parts, unchecked)
        robot._add_objects(config)
        robot._check_operators_frames(config)
        return robot

    @classmethod
    def from_urdf(
        cls,
        path_or_xml: str | os.PathLike[str],
        arms: Mapping[str, str],
        srdf: str | os.PathLike[str] | None = None,
        home: Mapping[str, float] | None = None,
        unchecked_links: Collection[str] = (),
    ) -> Robot:
        """Return a robot from any URDF.

        Movable joints behind the last joint of an arm count as joints of its fingers. The links to which these joints
        are attached, and all links behind them, are the arm's tool. No link counts as an obstacle. A warning names
        pairs that would block the arm at home, and pairs that overlap only at home.

        Args:
            path_or_xml: The URDF as a file or a text.
            arms: The tool frame of each arm, by the arm's name. A tool frame is a link of the URDF.
            srdf: An SRDF (file or text) that tells which pairs need no watching. Without it, links of one arm that
                overlap at home are taken to overlap by construction.
            home: Positions by joint [rad or m]. Other joints are at 0, or in the middle of their range if 0 is outside.
            unchecked_links: Names of links without a collision shape that shall not be watched.

        Raises:
            RobotError: If an argument cannot be used, or if a link has a mass but no shape and is not named.
        """
        text, where, folder = _text_of(path_or_xml, "URDF text")
        urdf = parse_urdf(text, where, folder)
        exclusions = None if srdf is None else parse_srdf(*_text_of(srdf, "SRDF text")[:2])
        names = [*arms, *arms.values()] if isinstance(arms, Mapping) else []
        if not names or not all(isinstance(name, str) and name for name in names):
            given = f"arms = {shown(arms)}"
            raise RobotError(f"{where}: {given}; expected a mapping such as {{'left': 'left_tool_frame'}}")
        if len(set(arms.values())) < len(arms):
            raise RobotError(f"{where}: arms = {shown(arms, 200)}: allowed: a tool frame of its own for each arm")
        positions = _home_of(urdf, home or {}, where)
        check_kind("unchecked_links", unchecked_links, (list, tuple, set, frozenset), "names of links", RobotError)
        robot = cls(urdf, exclusions, dict(arms), positions, where, unchecked_links=unchecked_links)
        check_watched(robot, where, in_cell=False)
        if (warning := warning_at_home(robot, exclusions, positions)) is not None:
            _logger.warning(warning)
        return robot

    def capped_acceleration(self, cap: float) -> Array:
        """Return acceleration limits (nv,) [rad/s^2]: for every joint, its own limit or ``cap``, whichever is smaller.

        Raises:
            RobotError: If ``cap`` is not a number above 0.
        """
        if not isinstance(cap, float | int | np.number) or not cap > 0:
            raise RobotError(f"acceleration cap = {shown(cap)}: allowed: a number above 0 [rad/s^2]")
        return np.minimum(self.acceleration_limit, cap)

    def arm(self, name: str) -> Arm:
        """Return the arm called ``name``; raises :class:`RobotError` if there is none."""
        if not isinstance(name, str) or name not in self.arms:
            raise RobotError(f"{self.name}: no arm {shown(name)}; arms: {', '.join(self.arms)}")
        return self.arms[name]

    def checked(self, name: str, values: npt.ArrayLike) -> Array:
        """Return a copy of ``values``, one for each joint (nv,).

        Raises:
            RobotError: With a text that begins with ``name``, if they have another shape or are not finite.
        """
        try:
            given = np.asarray(values)
            array = np.array(given, dtype=np.float64) if given.dtype.kind != "c" else np.empty(0)
        except (TypeError, ValueError, OverflowError):
            array = np.empty(0)
        if array.shape != (self.model.nv,) or not np.isfinite(array).all():
            raise RobotError(f"{name} = {shown(values)}: expected {self.model.nv} finite numbers, one for each joint")
        return array

    def tool_pose(self, q: npt.ArrayLike, arm: str) -> pin.SE3:
        """Return the pose of the arm's tool frame in the world at ``q`` (nv,).

        Raises:
            RobotError: If ``q`` has another shape or is not finite, or if the arm does not exist.
        """
        frame_id = self.arm(arm).frame_id
        pin.forwardKinematics(self.model, self._data, self.checked("q", q))
        return pin.updateFramePlacement(self.model, self._data, frame_id).copy()

    def distances(self, q: npt.ArrayLike) -> list[PairDistance]:
        """Return the distance of every monitored pair at ``q`` (nv,), in the order of the collision pairs.

        Coal computes the distances.

        Raises:
            RobotError: If ``q`` has another shape or is not finite.
        """
        values = self.distance_values(q).tolist()
        return [
            PairDistance(a, b, value) for (a, b), value in zip(pair_names(self.collision_model), values, strict=True)
        ]

    def distance_values(self, q: npt.ArrayLike) -> Array:
        """Return the same distances as :meth:`distances`, as an array (pairs,) [m]."""
        return self._distances.at(self.checked("q", q))

    def closest_points(self, q: npt.ArrayLike, pair: tuple[str, str]) -> Array | None:
        """Return the nearest points of a pair in the world at ``q`` (nv,), (2, 3) [m]; None if it is not monitored."""
        check_kind("pair", pair, tuple, "the names of two bodies", RobotError)
        names = pair_names(self.collision_model)
        if pair not in names:
            return None
        q, geometry_data = self.checked("q", q), self._distances.geometry_data
        pin.updateGeometryPlacements(self.model, self._data, self.collision_model, geometry_data, q)
        result = pin.computeDistance(self.collision_model, geometry_data, names.index(pair))
        return np.array([result.getNearestPoint1(), result.getNearestPoint2()])

    def _monitor(
        self, tree: LinkTree, exclusions: Iterable[ET.Element] | None, own_links: Sequence[set[str]]
    ) -> tuple[tuple[str, str], ...]:
        """Choose the monitored pairs. Returns the pairs of one arm that overlap by construction and are left out."""
        sink_boxes_into_floor(self.collision_model)
        add_movable_pairs(self.model, self.collision_model, tree)
        remove_unreachable_floor_pairs(self.model, self.collision_model)
        if exclusions is not None:
            remove_disabled_pairs(self.collision_model, exclusions)
        postures = [self.home]
        if exclusions is not None:
            # The SRDF decides which pairs are watched. In addition, pairs that overlap in all postures are dropped,
            # because no motion separates them.
            random = np.random.default_rng(0)
            postures += [random.uniform(self.position_lower, self.position_upper) for _ in range(50)]
        return remove_overlapping_own_pairs(self.model, self.collision_model, own_links, postures)

    def _add_objects(self, config: Config) -> None:
        configs: dict[str, HeldObjectConfig] = {
            side: arm.gripper.object for side, arm in config.arms.items() if arm.gripper.object is not None
        }
        tools = {name: arm.frame_id for name, arm in self.arms.items()}
        self.objects = held_objects(self.model, self.collision_model, self.roles, tools, configs)
        for arm, held in self.objects.by_arm.items():
            if held.link in self.roles:
                has = f"the cell has a link {held.link}"
                raise ConfigError(f"arms.{arm}.gripper.object: {has}; allowed: none of that name")
            self.roles[held.link] = Role(LinkClass.OBJECT, frozenset({arm}))

    def _check_operators_frames(self, config: Config) -> None:
        """If the external mode is ``filtered``, check that the operator's frame is at the cell's tool.

        Targets have to begin at the cell's tool.
        """
        if config.external is None or not config.external.filtered:
            return
        for arm in self.arms:
            frame, tool = config.external.arm(arm).tool_frame, self.arms[arm].tool_frame
            if frame is None or not self.model.existFrame(frame, pin.FrameType.BODY):
                continue  # Only /tf has this frame, so the arm's node checks its pose on /tf.
            at_home = self.tool_pose(self.home, arm)
            frame_id = self.model.getFrameId(frame, pin.FrameType.BODY)
            between = at_home.actInv(pin.updateFramePlacement(self.model, self._data, frame_id))
            distance, angle = (float(np.linalg.norm(way)) for way in (between.translation, pin.log3(between.rotation)))
            if max(distance, angle) > _SAME_FRAME:
                raise ConfigError(
                    f"external.arms.{arm}.tool_frame = {frame!r}: {distance:.3f} m and {angle:.2f} rad from {tool}, "
                    "the cell's tool, which mode filtered moves; "
                    f"allowed: a frame at the tool, or null with {tool} on /tf"
                )


def _home_of(urdf: ET.Element, given: Mapping[str, float], where: str) -> dict[str, float]:
    """Return the home position of every joint. ``given`` has the positions of some joints.

    Raises:
        RobotError: With a text that begins with ``where``, if a value of ``given`` is not allowed.
    """
    check_kind(f"{where}: home", given, Mapping, "positions by joint [rad or m]", RobotError)
    joints = {joint.get("name", ""): joint for joint in urdf.findall("joint") if joint.get("type") != "fixed"}
    for name, position in given.items():
        if name not in joints:
            raise RobotError(f"{where}: home: no joint {shown(name)} that moves; joints: {', '.join(joints)}")
        check_kind(f"{where}: home of {name}", position, (float, int, np.number), "a number [rad or m]", RobotError)
    try:
        with AllFaults() as faults:
            for name, position in given.items():
                with faults.of_part():
                    check_position(joints[name], float(position), f"home of {name}")
    except ConfigError as error:
        raise RobotError(f"{where}: {error}", [f"{where}: {fault}" for fault in error.faults]) from None
    limits = {name: joint_limits(joint) for name, joint in joints.items()}
    followers = followers_of(urdf.findall("joint"), driven=given)
    usual = {
        name: 0.0 if lower <= 0.0 <= upper else (lower + upper) / 2
        for name, (lower, upper) in limits.items()
        if name not in followers
    }
    return with_followers(usual | {name: float(position) for name, position in given.items()}, followers)


def _text_of(path_or_text: str | os.PathLike[str], name_of_text: str) -> tuple[str | bytes, str, Path | None]:
    """Return the text, its name in errors, and the folder of its file. The folder is None if there is no file."""
    if not isinstance(path_or_text, str | os.PathLike):
        raise RobotError(f"{shown(path_or_text)}: neither {name_of_text} nor the path of a file")
    if isinstance(path_or_text, str) and path_or_text.lstrip().startswith("<"):
        return path_or_text, name_of_text, None
    try:
        file = Path(path_or_text)
        # The bytes are not decoded, because the first line of XML may name an encoding.
        return file.read_bytes(), str(file), file.parent
    except (OSError, ValueError) as error:
        raise RobotError(f"{str(path_or_text)[:200]!r}: neither XML nor a file that can be read: {error}") from error
