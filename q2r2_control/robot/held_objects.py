"""Held objects: bodies that are fixed to the tools, and the monitored pairs with them.

The objects are in a copy of ``Robot.collision_model``, after its own bodies and pairs. An object has pairs with the
same bodies as the link to which it is fixed, and with all obstacles. It has no pairs with the gripper that holds it,
and none with the fingers of other grippers, because these must be able to take the object over.

**The distance of two boxes** has no short closed form. One of the two closest points of two convex polyhedra can be
taken on an edge. If both points lie inside of faces, these faces are parallel. Both points can then be moved along
the faces until one of the points meets an edge. When two polyhedra begin to overlap, an edge of one of them enters the
other one. The distance of two boxes is therefore the least distance of the twelve edges of each box from the other box.
Each edge is a capsule without a radius.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations, product

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.config.arms import HeldObjectConfig
from q2r2_control.robot.enclose import capsule_between
from q2r2_control.robot.floor import FLOOR
from q2r2_control.robot.pairs import LinkClass, Role, link_of, pair_names


@dataclass(frozen=True, slots=True)
class HeldObject:
    """The object of one gripper. It is fixed to the last joint that moves the tool."""

    arm: str
    link: str  # The link after which its bodies are named.
    joint: int  # Index of the joint in ``Robot.model`` to which the object is fixed.
    placement: pin.SE3  # Pose of the object's centre in the frame of that joint.
    config: HeldObjectConfig

    def inertia(self, share: float = 1.0) -> pin.Inertia:
        """Return the inertia of a uniform box or ball with a ``share`` of the object's mass, in the joint's frame."""
        mass, box = share * self.config.mass, self.config.box
        own = pin.Inertia.FromSphere(mass, self.config.radius) if box is None else pin.Inertia.FromBox(mass, *box)
        return own.se3Action(self.placement)


@dataclass(frozen=True, slots=True)
class HeldObjects:
    """All objects of a cell."""

    geometry: pin.GeometryModel  # ``Robot.collision_model``, followed by the bodies and pairs of objects.
    by_arm: dict[str, HeldObject]
    # For each of the objects' pairs, the arms that have to hold their objects so that the pair counts.
    holders: tuple[frozenset[str], ...]

    def pair_names(self) -> tuple[tuple[str, str], ...]:
        """Return the names of both bodies of each of the objects' pairs."""
        names = pair_names(self.geometry)
        return names[len(names) - len(self.holders) :]


def held_objects(
    model: pin.Model,
    geometry: pin.GeometryModel,
    roles: Mapping[str, Role],
    tool_frames: Mapping[str, int],
    configs: Mapping[str, HeldObjectConfig],
) -> HeldObjects:
    """Return the objects that ``configs`` describe, by arm. ``tool_frames`` are frames of ``model``."""
    by_arm: dict[str, HeldObject] = {}
    for arm, config in configs.items():
        frame = model.frames[tool_frames[arm]]
        placement = frame.placement * pin.SE3(pin.rpy.rpyToMatrix(*config.rpy), np.array(config.at))
        by_arm[arm] = HeldObject(arm, f"{arm}_object", frame.parentJoint, placement, config)
    if not by_arm:
        return HeldObjects(geometry, {}, ())
    made = _Pairs(geometry.copy())
    for arm, held in by_arm.items():
        made.add_object(held)
        for other in _watched(geometry, roles, held):
            made.watch({arm}, held.link, other)
    for one, two in combinations(by_arm.values(), 2):
        if one.joint != two.joint:
            made.watch({one.arm, two.arm}, one.link, two.link)
    return HeldObjects(made.geometry, by_arm, tuple(made.holders))


class _Pairs:
    """A geometry model to which objects and their pairs are added."""

    def __init__(self, geometry: pin.GeometryModel) -> None:
        self.geometry = geometry
        self.holders: list[frozenset[str]] = []
        self._solids = {item.name: index for index, item in enumerate(geometry.geometryObjects)}
        self._edges: dict[str, list[int]] = {}  # The edges of boxes, by the name of the solid.

    def add_object(self, held: HeldObject) -> None:
        """Add the box or the ball itself, with the name of its link."""
        box = held.config.box
        shape = coal.Sphere(held.config.radius) if box is None else coal.Box(*box)
        self._solids[held.link] = self._add(f"{held.link}_solid", held.joint, shape, held.placement)

    def watch(self, holders: Iterable[str], first: str, second: str) -> None:
        """Add the pairs between two solids. These pairs count while all arms in ``holders`` hold their objects."""
        pairs = [(self._solids[first], self._solids[second])]
        if self._is_box(first) and self._is_box(second):
            pairs = [(edge, self._solids[second]) for edge in self._edges_of(first)]
            if link_of(second) != FLOOR:  # The edges of the floor are out of reach.
                pairs += [(edge, self._solids[first]) for edge in self._edges_of(second)]
        for pair in pairs:
            self.geometry.addCollisionPair(pin.CollisionPair(*pair))
            self.holders.append(frozenset(holders))

    def _is_box(self, solid: str) -> bool:
        return isinstance(self.geometry.geometryObjects[self._solids[solid]].geometry, coal.Box)

    def _edges_of(self, solid: str) -> list[int]:
        if solid not in self._edges:
            item = self.geometry.geometryObjects[self._solids[solid]]
            link, joint, placement = link_of(item.name), item.parentJoint, item.placement.copy()
            half, edges = np.array(item.geometry.halfSide), self._edges.setdefault(solid, [])
            for axis, signs in product(range(3), product((-1.0, 1.0), repeat=2)):
                corner, other = (half * np.insert(np.array(signs), axis, end) for end in (1.0, -1.0))
                edge = capsule_between(0.0, placement.act(other), placement.act(corner))
                edges.append(self._add(f"{link}_edge{len(edges)}", joint, *edge))
        return self._edges[solid]

    def _add(self, name: str, joint: int, shape: coal.CollisionGeometry, placement: pin.SE3) -> int:
        return int(self.geometry.addGeometryObject(pin.GeometryObject(name, joint, placement, shape)))


def _watched(geometry: pin.GeometryModel, roles: Mapping[str, Role], held: HeldObject) -> list[str]:
    """Return the bodies with which the object has pairs. The gripper that holds it and all fingers are left out."""
    items = geometry.geometryObjects
    # All obstacles count, also those that the gripper itself cannot reach, because an object reaches farther.
    found = dict.fromkeys(item.name for item in items if roles[link_of(item.name)].part is LinkClass.OBSTACLE)
    for pair in geometry.collisionPairs:
        first, second = items[pair.first], items[pair.second]
        for one, other in ((first, second), (second, first)):
            role = roles[link_of(other.name)]
            takes = role.part is LinkClass.FINGER or (role.part is LinkClass.TOOL and held.arm in role.arms)
            if one.parentJoint == held.joint != other.parentJoint and not takes:
                found[other.name] = None
    return list(found)
