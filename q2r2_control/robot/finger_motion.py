"""Judge by shapes whether joints move fingers: bodies that come together at one end of the joints' travel.

The tip of a finger is the part of its outermost body that is far from that body's joint. The tips of a gripper come
nearer to each other, or to the body that carries them, the palm. Where they are nearest, the gripper is closed. A wrist
brings its tool to no such place.
"""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import coal
import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from q2r2_control.errors import RobotError
from q2r2_control.robot.description import Description, LinkTree, joint_end, joint_limits
from q2r2_control.robot.followers import followers_of, with_followers
from q2r2_control.robot.pinocchio_models import joint_axis, read_models, resting_position
from q2r2_control.robot.urdf_forms import scale_to_metres
from q2r2_control.robot.urdf_parts import shape_from_drawings
from q2r2_control.types import Array

# Shares of their greatest distance at which tips are close, or have hardly moved. Known grippers have 0.1 to 0.75.
CLOSE, HARDLY_MOVED = 0.8, 0.95
_TIP = 0.6  # A tip begins at this share of its body's reach from the joint.
# For a single jaw:
_WIDEST_TURN, _LONGEST_SLIDE = 2.7, 0.2  # Longest travel [rad], [m].
_NEAR = 0.2  # Greatest distance of the closed jaw from the palm's hull, as a share of the jaw's reach or of its slide.
_ACROSS = 0.7  # Least share of the jaw's reach that is across its axis. The tool of a wrist lies along the axis.
_ALONG_ARM = 0.7  # Greatest share of a jaw's slide that is along the arm.
_BACKWARDS = -0.3  # Least cosine of the angle between the closed jaw and the way from the joint before it.
_SAME_PLACE = 0.02  # Axes that are nearer to each other count as one place [m].


@dataclass(frozen=True, slots=True)
class Closing:
    """The distances of a gripper's tips at both ends of the travel of its joints."""

    closed: float  # Positions of the joints [m or rad].
    opened: float
    nearest: float  # Mean distance where the gripper is closed, and where it is open [m].
    farthest: float
    onto: str  # "each other" or "the palm"

    @property
    def share(self) -> float:
        """The share of the distance that is left where the gripper is closed."""
        return self.nearest / self.farthest

    def __str__(self) -> str:
        away = f"{1e3 * self.farthest:.0f} mm from {self.onto} at {self.opened:g}"
        return f"the tips that they move are {away} and {1e3 * self.nearest:.0f} mm at {self.closed:g}"


class FingerMotion:
    """Moves joints at the end of a model's arms, and measures which tips come together.

    Drawings stand for links without collision shapes, and origins of links for bodies without either.
    """

    def __init__(self, description: Description, tree: LinkTree) -> None:
        self._description, self._tree = description, tree
        self._movable = tree.movable()
        self._bodies: dict[str, dict[int, Array]] = {}  # By the first link of a palm.

    def closing(self, driven: Sequence[str]) -> Closing | None:
        """Return where the joints ``driven``, which have one travel, bring tips together; None if nothing tells."""
        ends = joint_limits(self._movable[driven[0]])
        found = np.array([self._distances(driven, end) for end in ends])
        closings = [
            Closing(*(ends if first < second else ends[::-1]), min(first, second), max(first, second), onto)
            for (first, second), onto in zip(found.T.tolist(), ("each other", "the palm"), strict=True)
            if abs(first - second) > 1e-6
        ]
        return min(closings, key=lambda one: one.share, default=None)

    def is_jaw(self, name: str) -> bool | None:
        """Return whether the joint ``name`` alone closes a jaw; None if the shapes leave a doubt, or tell nothing."""
        if not {self._id(name), self._model.parents[self._id(name)]} <= {*self._bodies_on(self._palm_of(name))}:
            return None
        joint = self._movable[name]
        lower, upper = joint_limits(joint)
        if upper - lower > (_LONGEST_SLIDE if joint.get("type") == "prismatic" else _WIDEST_TURN):
            return False
        closing = self.closing([name])
        if closing is None or closing.share > HARDLY_MOVED or not self._lies_like_a_jaw(name, closing):
            return False
        return True if closing.share <= CLOSE else None

    @cached_property
    def _model(self) -> pin.Model:
        return read_models(self._with_shapes_of(()), str(self._description.file))[0]

    def _id(self, name: str) -> int:
        return int(self._model.getJointId(name))

    def _placed(self, driven: Sequence[str], position: float) -> pin.Data:
        """Return the model's data with ``driven`` at ``position``, what follows them with them, and others at rest."""
        followers = followers_of(self._tree.joint_to.values(), driven)
        rest = {name: resting_position(joint) for name, joint in self._movable.items() if name not in followers}
        q, data = pin.neutral(self._model), self._model.createData()
        for name, value in with_followers(rest | dict.fromkeys(driven, position), followers).items():
            joint = self._model.joints[self._id(name)]
            if joint.nq == 1:
                q[joint.idx_q] = value
        pin.forwardKinematics(self._model, data, q)
        return data

    def _distances(self, driven: Sequence[str], position: float) -> tuple[float, ...]:
        """Return the mean distances of moved tips from other tips and from palms [m]; 0 where there are none."""
        data = self._placed(driven, position)
        followers = followers_of(self._tree.joint_to.values(), driven)
        moving = [*driven, *(name for name, one in followers.items() if one.driver in driven)]
        moved = [name for name in moving if not {*moving} & {*self._names_to(name)[:-1]}]
        palms = {self._palm_of(name) for name in moved}
        beside = [name for name in self._movable if self._palm_of(name) in palms]
        # A linkage has branches without shapes, which tell nothing where others have shapes.
        shaped = [name for name in beside if self._has_shape_beyond(name)]
        tips = {}
        for name in shaped if {*shaped} & {*moved} else beside:
            joint, points = self._tip_of(name)
            tips[name] = data.oMi[joint].act(points.mean(axis=0))
        apart = [np.linalg.norm(tips[a] - tips[b]) for a, b in combinations(tips, 2) if a in moved or b in moved]
        away = []
        for name in moved:
            palm = int(self._model.parents[self._id(name)])
            if name in tips and (corners := self._bodies_on(self._palm_of(name)).get(palm)) is not None:
                away.append(np.linalg.norm(tips[name] - data.oMi[palm].act(corners.mean(axis=0))))
        return tuple(float(np.mean(found)) if found else 0.0 for found in (apart, away))

    def _has_shape_beyond(self, name: str) -> bool:
        bodies = self._bodies_on(self._palm_of(name))
        return any(name in self._names_to(other) and self._id(other) in bodies for other in self._movable)

    def _tip_of(self, name: str) -> tuple[int, Array]:
        """Return the outermost body beyond a joint, by its joint's number, and its tip (n, 3) in that joint's frame."""
        beyond = [other for other in self._movable if name in self._names_to(other)]
        bodies = self._bodies_on(self._palm_of(name))
        shaped = [other for other in beyond if self._id(other) in bodies]
        outermost = max(shaped or beyond, key=lambda other: len(self._names_to(other)))
        number = self._id(outermost)
        if not shaped:
            links = self._tree.fixed_to(joint_end(self._movable[outermost], "child"))
            frames = [self._model.frames[self._model.getFrameId(link, pin.FrameType.BODY)] for link in links]
            return number, np.array([frame.placement.translation for frame in frames])
        points = bodies[number]
        if self._movable[outermost].get("type") == "prismatic":
            return number, points
        reach = np.linalg.norm(points, axis=1)
        return number, points[reach >= _TIP * reach.max()]

    def _lies_like_a_jaw(self, name: str, closing: Closing) -> bool:
        """Return whether the closed jaw is beside a part of its palm that reaches on from the arm."""
        data, joint = self._placed([name], closing.closed), self._movable[name]
        number, tip = self._tip_of(name)
        hinge, palm = data.oMi[self._id(name)], int(self._model.parents[self._id(name)])
        points = np.array([data.oMi[number].act(point) for point in tip])
        hull = np.array([data.oMi[palm].act(point) for point in self._bodies_on(self._palm_of(name))[palm]])
        axis = hinge.rotation @ joint_axis(joint)
        before = [hinge.translation - data.oMi[self._id(other)].translation for other in self._names_to(name)[:-1]]
        onwards = next((way for way in reversed(before) if np.linalg.norm(way) > _SAME_PLACE), np.zeros(3))
        reach = points.mean(axis=0) - hinge.translation
        length, way = float(np.linalg.norm(reach)), float(np.linalg.norm(onwards))
        if joint.get("type") == "prismatic":
            lower, upper = joint_limits(joint)
            return abs(axis @ onwards) <= _ALONG_ARM * way and _gap(points, hull) <= _NEAR * (upper - lower)
        across = float(np.linalg.norm(reach - (reach @ axis) * axis))
        is_back = reach @ onwards < _BACKWARDS * length * way  # As the forearm of an elbow that is bent.
        return across >= _ACROSS * length and not is_back and _gap(points, hull) <= _NEAR * length

    def _names_to(self, name: str) -> list[str]:
        """Return the movable joints from the root to the joint ``name``, with it."""
        return [joint.get("name", "") for joint in self._tree.chain(joint_end(self._movable[name], "child"))]

    def _palm_of(self, name: str) -> str:
        """Return the first link of the body that carries the joint ``name``."""
        link = joint_end(self._movable[name], "parent")
        while link in self._tree.joint_to and self._tree.joint_to[link].get("type") == "fixed":
            link = joint_end(self._tree.joint_to[link], "parent")
        return link

    def _bodies_on(self, palm: str) -> dict[int, Array]:
        """Return corners of the shapes (n, 3) [m] of ``palm`` and of all that it carries, by joint, in its frame."""
        if palm not in self._bodies:
            links = {link for link in (self._tree.root, *self._tree.joint_to) if palm in self._tree.path(link)}
            points: dict[int, list[Array]] = {}
            for item in self._shapes_of(links).geometryObjects:
                corners = np.array([item.placement.act(point) for point in _corners(item.geometry)])
                points.setdefault(int(item.parentJoint), []).append(corners)
            self._bodies[palm] = {joint: np.concatenate(parts) for joint, parts in points.items()}
        return self._bodies[palm]

    def _shapes_of(self, links: Collection[str]) -> pin.GeometryModel:
        where = str(self._description.file)
        try:
            return read_models(self._with_shapes_of(links, drawn=True), where)[1]
        except RobotError:  # A drawing may be of a kind that only viewers read.
            return read_models(self._with_shapes_of(links), where)[1]

    def _with_shapes_of(self, links: Collection[str], drawn: bool = False) -> ET.Element:
        """Return a copy of the model with the shapes of ``links`` only, on request with drawings for missing ones."""
        urdf = copy.deepcopy(self._description.urdf)
        for joint in urdf.findall("joint"):  # Pinocchio reads no limits that lack a speed or an effort.
            limit = joint.find("limit")
            if joint.get("type") != "fixed":
                limit = ET.SubElement(joint, "limit") if limit is None else limit
                limit.attrib |= {what: limit.get(what, "0") for what in ("velocity", "effort")}
        without = ET.Element("robot")
        for link in urdf.findall("link"):
            if link.get("name") not in links:
                for shape in link.findall("collision"):
                    link.remove(shape)
            elif drawn and link.find("collision") is None:
                without.append(link)
        shape_from_drawings(without.findall("link"), links)
        scale_to_metres(without)
        return urdf


def _corners(shape: coal.CollisionGeometry) -> Array:
    """Return the vertices of a mesh's convex hull, or the corners of the box around another shape (n, 3) [m]."""
    if isinstance(shape, coal.BVHModelBase):
        points = np.array(shape.vertices())
        return points if len(points) < 4 else points[ConvexHull(points, qhull_options="QJ").vertices]
    shape.computeLocalAABB()
    box = shape.aabb_local
    return np.array(np.meshgrid(*zip(box.min_, box.max_, strict=True))).reshape(3, -1).T


def _gap(points: Array, body: Array) -> float:
    """Return a lower bound of the distance of ``points`` (n, 3) from the hull of ``body`` (m, 3) [m]."""
    if len(body) < 4:
        return float(np.linalg.norm(points[:, None] - body, axis=2).min())
    hull = ConvexHull(body, qhull_options="QJ")
    return float((hull.equations[:, :3] @ points.T + hull.equations[:, 3:]).max(axis=0).min())
