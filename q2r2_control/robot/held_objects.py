"""Held objects: bodies that are fixed to the tools, and the pairs that are watched with them.

They stand in a copy of ``Robot.collision_model`` that ends with them and their pairs. An object is watched against the
same bodies as its link. Its own hand is left out, and so are the fingers of other hands, which have to be able to take
it over.

**Boxes against boxes** have no short closed form. Where two convex polyhedra are closest, one of the two points can be
taken on an edge. If both lie inside of faces, these are parallel, and both points may be moved along them until one
meets an edge. And two of them cannot begin to overlap but by an edge of one in the other. The distance of two boxes is
therefore the least one of the twelve edges of each from the other box. Each edge is a capsule without a radius.
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
    """The object of one gripper, fixed to the joint that carries the tool."""

    arm: str
    link: str  # that its bodies are named by
    joint: int  # in ``Robot.model``
    placement: pin.SE3  # of its centre, in that joint's frame
    config: HeldObjectConfig

    def inertia(self, share: float = 1.0) -> pin.Inertia:
        """Of a uniform box or ball with a share of its mass, in the joint's frame."""
        mass, box = share * self.config.mass, self.config.box
        own = pin.Inertia.FromSphere(mass, self.config.radius) if box is None else pin.Inertia.FromBox(mass, *box)
        return own.se3Action(self.placement)


@dataclass(frozen=True, slots=True)
class HeldObjects:
    """All objects of a cell."""

    geometry: pin.GeometryModel  # ``Robot.collision_model``, and after its bodies and pairs those of objects
    by_arm: dict[str, HeldObject]
    holders: tuple[frozenset[str], ...]  # of each of the objects' pairs: arms that have to hold for it to count

    def pair_names(self) -> tuple[tuple[str, str], ...]:
        """Names of both bodies of each of the objects' pairs."""
        names = pair_names(self.geometry)
        return names[len(names) - len(self.holders) :]


def held_objects(
    model: pin.Model,
    geometry: pin.GeometryModel,
    roles: Mapping[str, Role],
    tool_frames: Mapping[str, int],
    configs: Mapping[str, HeldObjectConfig],
) -> HeldObjects:
    """The objects that ``configs`` describe, by arm; ``tool_frames`` are frames of ``model``."""
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
    """A geometry model that objects and their pairs are added to."""

    def __init__(self, geometry: pin.GeometryModel) -> None:
        self.geometry = geometry
        self.holders: list[frozenset[str]] = []
        self._solids = {item.name: index for index, item in enumerate(geometry.geometryObjects)}
        self._edges: dict[str, list[int]] = {}  # of boxes, by the solid's name

    def add_object(self, held: HeldObject) -> None:
        """The box or the ball itself, by the name of its link."""
        box = held.config.box
        shape = coal.Sphere(held.config.radius) if box is None else coal.Box(*box)
        self._solids[held.link] = self._add(f"{held.link}_solid", held.joint, shape, held.placement)

    def watch(self, holders: Iterable[str], first: str, second: str) -> None:
        """Watch the pairs of two solids. They count while all grippers in ``holders`` hold their object."""
        pairs = [(self._solids[first], self._solids[second])]
        if self._is_box(first) and self._is_box(second):
            pairs = [(edge, self._solids[second]) for edge in self._edges_of(first)]
            if link_of(second) != FLOOR:  # whose edges are out of reach
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
    """Bodies that those on the object's link are watched against, but for hands that hold, or take, the object."""
    items = geometry.geometryObjects
    # Obstacles all, also those that the hand itself cannot reach: an object reaches farther.
    found = dict.fromkeys(item.name for item in items if roles[link_of(item.name)].part is LinkClass.OBSTACLE)
    for pair in geometry.collisionPairs:
        first, second = items[pair.first], items[pair.second]
        for one, other in ((first, second), (second, first)):
            role = roles[link_of(other.name)]
            takes = role.part is LinkClass.FINGER or (role.part is LinkClass.TOOL and held.arm in role.arms)
            if one.parentJoint == held.joint != other.parentJoint and not takes:
                found[other.name] = None
    return list(found)
