"""Make the bodies of moving obstacles. Each obstacle has one body, and this body has a pair with every moving body.

The bodies of obstacles come last in the collision geometry with which a controller is made. Their shapes and poses are
written at run time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import product

import coal
import numpy as np
import pinocchio as pin

from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.errors import ConfigError
from q2r2_control.robot.coal_distances import CoalDistances
from q2r2_control.robot.enclose import capsule_between, enclosing_capsule
from q2r2_control.robot.held_objects import HeldObject
from q2r2_control.robot.pairs import LinkClass, Role
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

HULL = "_hull"  # The ending of the name of the capsule around a held object.
_SHAPES = {"sphere": coal.Sphere, "capsule": coal.Capsule, "box": coal.Box}


def body_of(name: str, obstacle: MovingObstacle) -> pin.GeometryObject:
    """Return the body of an obstacle at the pose in the world at which it was reported."""
    placement = pin.SE3(pin.rpy.rpyToMatrix(*obstacle.rpy), np.array(obstacle.position))
    return pin.GeometryObject(name, 0, placement, _SHAPES[obstacle.shape](*obstacle.size))


def with_obstacle_bodies(robot: Robot, names: Iterable[str], held: bool = True) -> pin.GeometryModel:
    """Return a copy of ``Robot.objects.geometry``, followed by a sphere with its pairs for each of ``names``.

    If ``held`` is False, these bodies follow the collision model without held objects. A held object counts as the
    capsule around it, because two boxes would need pairs of all their edges.
    """
    known = robot.objects.geometry if held else robot.collision_model
    if not names:
        return known
    geometry = known.copy()
    moving = [i for i, item in enumerate(robot.collision_model.geometryObjects) if item.parentJoint != 0]
    moving += [int(geometry.addGeometryObject(_hull(one))) for one in robot.objects.by_arm.values() if held]
    for name in names:
        body = geometry.addGeometryObject(pin.GeometryObject(f"{name}_0", 0, pin.SE3.Identity(), coal.Sphere(1.0)))
        for number in moving:
            geometry.addCollisionPair(pin.CollisionPair(number, body))
    return geometry


def distances_with(robot: Robot, obstacles: Mapping[str, MovingObstacle]) -> Callable[[Array], Array]:
    """Return a function that measures all pairs of :func:`with_obstacle_bodies` by Coal.

    The function takes the positions q (nv,) and returns the distances (p,) [m].
    """
    geometry = with_obstacle_bodies(robot, obstacles)
    for number, (name, obstacle) in enumerate(obstacles.items(), geometry.ngeoms - len(obstacles)):
        geometry.geometryObjects[number] = body_of(name, obstacle)
    return CoalDistances(robot.model, geometry).at


def roles_with_obstacles(robot: Robot, names: Iterable[str]) -> dict[str, Role]:
    """Return the roles of links and of moving obstacles.

    Raises:
        ConfigError: If an obstacle has the name of a link.
    """
    for name in names:
        if name in robot.roles:
            raise ConfigError(f"control.moving_obstacles: {name}: the cell has a link {name}; allowed: another name")
    return robot.roles | dict.fromkeys(names, Role(LinkClass.OBSTACLE, frozenset()))


def _hull(held: HeldObject) -> pin.GeometryObject:
    shape, placement = coal.Sphere(held.config.radius), held.placement
    if held.config.box is not None:
        corners = np.array(list(product((-0.5, 0.5), repeat=3))) * held.config.box
        shape, within = capsule_between(*enclosing_capsule(corners))
        placement = placement * within
    return pin.GeometryObject(f"{held.link}{HULL}", held.joint, placement, shape)
