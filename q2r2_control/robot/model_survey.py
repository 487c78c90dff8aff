"""Find out what a model alone tells about its arms, fingers and shapes, before a cell is written for it."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
import pinocchio as pin
from scipy.spatial import ConvexHull

from q2r2_control.errors import ConfigError
from q2r2_control.robot.arm_chain import arm_ends, default_tip, end_of
from q2r2_control.robot.description import Description, LinkTree, joint_end, joint_limits
from q2r2_control.robot.enclose import Capsule, capsules_around, enclose_shapes
from q2r2_control.robot.followers import Follower, followers_of, with_followers
from q2r2_control.robot.pairs import link_of, links_moved_by
from q2r2_control.robot.pinocchio_models import read_models
from q2r2_control.robot.urdf_parts import mimic_of
from q2r2_control.types import Array

_ARM_NAME = re.compile(r"arm|hand|grip|wrist|elbow|shoulder", re.IGNORECASE)
_SIDE_NAMES = {side: re.compile(rf"{side}|(^|[_-]){side[0]}([_-]|$)", re.IGNORECASE) for side in ("left", "right")}
_ON_SPHERE = 400  # Number of points on the surface of a capsule that are compared with its mesh.
_IN_BOX = 20_000  # Number of random points by which the volume of several capsules is measured.
_SEVERAL = (2, 3)  # Numbers of capsules that are tried.
# Several capsules may have at most the first share of one capsule's volume. Each further capsule has to save at least
# the second share, because it costs more pairs.
_CLEARLY_LESS, _EACH_SAVES = 0.8, 0.1
# Greatest position, force and speed that a cell's gripper may have [m or rad], [N or Nm], [m/s or rad/s].
_WIDEST, _STRONGEST, _FASTEST = 3.15, 500.0, 5.0


def tip_of(tree: LinkTree, key: str) -> str:
    """Return the last link of the model's arm: the only possible one, or the last link of the only long chain.

    Raises:
        ConfigError: With a text that begins with ``key`` and names the candidates, if there are several.
    """
    try:
        return default_tip(tree, (), key)
    except ConfigError:
        if len(tips := _tips(tree, key)) == 1:
            return tips[0]
        raise


def tips_by_side(tree: LinkTree, key: str) -> dict[str, str]:
    """Return the last link of each arm, by side, of a model that has both arms.

    Raises:
        ConfigError: With a text that begins with ``key``, if not exactly one link belongs to each side.
    """
    tips = _tips(tree, key)
    found = {
        side: [tip for tip in tips if any(map(name.search, tree.path(tip)[-3:]))] for side, name in _SIDE_NAMES.items()
    }
    if any(len(ends) != 1 for ends in found.values()):
        raise ConfigError(f"{key}: no left and right among the ends of its chains: {', '.join(tips) or 'none'}")
    return {side: ends[0] for side, ends in found.items()}


def _tips(tree: LinkTree, key: str) -> list[str]:
    """Return the ends of long chains. If the names show which chains are arms, only these count."""
    ends = arm_ends(tree)
    named = [end for end in ends if any(map(_ARM_NAME.search, tree.path(end)))]
    return [end_of(tree, end, key) for end in named or ends]


def limits_lacking(tree: LinkTree, tip: str) -> list[str]:
    """Return a line for each of the arm's joints that lacks limits."""
    limits = []
    for joint in tree.chain(tip):
        limit, name = joint.find("limit"), joint.get("name", "")
        if (kind := joint.get("type")) in ("floating", "planar"):
            limits.append(f"{name} is {kind}, and the base of an arm is fixed: make it fixed")
            continue
        written = {} if limit is None else limit.attrib
        lacking = [what for what in ("velocity", "effort") if not float(written.get(what, "0")) > 0.0]
        lower, upper = joint_limits(joint)
        lacking += [] if lower < upper else ["lower and upper"]
        limits += [f"{name} has no {' and no '.join(lacking)} limit"] if lacking else []
    return limits


def gripper_of(description: Description, tree: LinkTree, tip: str) -> dict[str, Any]:
    """Return the settings of the gripper beyond the arm's last joint; empty if there is no gripper.

    The gripper is closed at that end of its travel at which the fingers are nearer to the axis of the arm's last joint.
    """
    last = tree.chain(tip)[-1]
    beyond = {
        name: joint
        for name, joint in tree.movable().items()
        if joint is not last and joint_end(last, "child") in tree.path(joint_end(joint, "parent"))
    }
    driven = [name for name, joint in beyond.items() if mimic_of(joint) is None and joint.get("type") != "floating"]
    if not driven:
        return {}
    # A cell drives all finger joints alike. Therefore only the joints with the most frequent travel are taken.
    travels = [joint_limits(beyond[name]) for name in driven]
    ends = max(travels, key=travels.count)
    driven = [name for name, travel in zip(driven, travels, strict=True) if travel == ends]
    model, geometry = read_models(description.urdf, str(description.file))
    enclose_shapes(geometry)
    moved = links_moved_by(tree, driven)
    shapes = [item for item in geometry.geometryObjects if link_of(item.name) in moved]
    followers = followers_of(tree.joint_to.values(), driven)
    spans = [_span(model, shapes, last.get("name", ""), beyond, driven, followers, end) for end in ends]
    closed, opened = ends if spans[0] < spans[1] else ends[::-1]
    limit = beyond[driven[0]].find("limit")
    speed, force = (0.0 if limit is None else float(limit.get(what, "0")) for what in ("velocity", "effort"))
    return {
        "joints": driven,
        "open_position": float(np.clip(opened, -_WIDEST, _WIDEST)),
        "closed_position": float(np.clip(closed, -_WIDEST, _WIDEST)),
        **({"speed": min(speed, _FASTEST)} if speed > 0.0 else {}),
        **({"force": min(force, _STRONGEST)} if force > 0.0 else {}),
    }


def _span(
    model: pin.Model,
    shapes: Sequence[pin.GeometryObject],
    axis_joint: str,
    beyond: dict[str, ET.Element],
    driven: Sequence[str],
    followers: Mapping[str, Follower],
    end: float,
) -> float:
    """Return the mean distance of the fingers from the axis of the arm's last joint [m], with ``driven`` at ``end``."""
    q, data = pin.neutral(model), model.createData()
    places = with_followers(dict.fromkeys(driven, end), followers)
    for name in beyond:
        if name in places and model.joints[index := model.getJointId(name)].nq == 1:
            q[model.joints[index].idx_q] = places[name]
    pin.forwardKinematics(model, data, q)
    last = model.getJointId(axis_joint)
    along = pin.computeJointJacobian(model, data, q, last)[:, model.joints[last].idx_v][3:]
    axis = data.oMi[last].rotation @ along
    moved = {model.getJointId(name) for name in beyond}
    points = [data.oMi[item.parentJoint].act(item.placement.translation) for item in shapes]
    points = points or [data.oMi[joint].translation for joint in moved]
    levers = [point - data.oMi[last].translation for point in points]
    return float(np.mean([np.linalg.norm(lever - (lever @ axis) * axis) for lever in levers]))


@dataclass(frozen=True, slots=True)
class CapsuleFit:
    """The capsule that encloses a mesh and replaces it, and how well it fits."""

    link: str
    radius: float  # [m]
    length: float  # Length of its segment [m].
    beyond: float  # Lower bound on the greatest distance of its surface from the mesh's convex hull [m].
    wasted: float  # Share of its volume that is outside the hull.
    capsules: int  # Number of capsules with clearly less volume than one capsule; 1 if there is no such number.
    then_wasted: float  # Share of the volume of ``capsules`` capsules that is outside the hull.


def capsule_fits(description: Description, several: Collection[str]) -> list[CapsuleFit]:
    """Return how well capsules fit the collision meshes of a model, the worst first.

    Several capsules are tried for the meshes of links in ``several``.
    """
    _, meshes = read_models(description.urdf, str(description.file))
    capsules = meshes.copy()
    enclose_shapes(capsules)
    fits = []
    for mesh, item in zip(meshes.geometryObjects, capsules.geometryObjects, strict=True):
        if not isinstance(mesh.geometry, coal.BVHModelBase) or not isinstance(item.geometry, coal.Capsule):
            continue
        points = np.array(mesh.geometry.vertices())
        if len(points) <= points.shape[1]:  # The mesh is a single triangle.
            continue
        hull = ConvexHull(points, qhull_options="QJ")  # The option QJ allows flat meshes as well.
        radius, half = float(item.geometry.radius), float(item.geometry.halfLength)
        surface = mesh.placement.actInv(item.placement)
        on = [surface.act(point) for point in _on_capsule(radius, half)]
        beyond = float((hull.equations[:, :3] @ np.array(on).T + hull.equations[:, 3:]).max())
        volume = np.pi * radius**2 * (2.0 * half + 4.0 / 3.0 * radius)
        link, volumes = link_of(mesh.name), {1: volume}
        if link in several:
            volumes |= {count: _volume_of(capsules_around(mesh.geometry, mesh.name, count)) for count in _SEVERAL}
        count = min(volumes, key=lambda count: volumes[count] / volume + _EACH_SAVES * count)
        count = count if volumes[count] <= _CLEARLY_LESS * volume else 1
        wasted, then_wasted = (max(1.0 - float(hull.volume) / volumes[number], 0.0) for number in (1, count))
        fits.append(CapsuleFit(link, radius, 2.0 * half, beyond, wasted, count, then_wasted))
    return sorted(fits, key=lambda fit: -fit.wasted)


def _volume_of(capsules: Sequence[Capsule]) -> float:
    """Return the volume of the union of capsules [m^3], estimated by random points from a fixed seed."""
    ends = np.array([[start, end] for _, start, end in capsules])
    radii = np.array([radius for radius, _, _ in capsules])[:, None, None]
    low, high = (ends - radii).min(axis=(0, 1)), (ends + radii).max(axis=(0, 1))
    points = np.random.default_rng(0).uniform(low, high, (_IN_BOX, 3))
    held = np.zeros(_IN_BOX, dtype=bool)
    for radius, start, end in capsules:
        along = end - start
        share = np.clip((points - start) @ along / max(float(along @ along), 1e-12), 0.0, 1.0)
        held |= np.linalg.norm(points - start - share[:, None] * along, axis=1) <= radius
    return float(np.prod(high - low) * held.mean())


def _on_capsule(radius: float, half: float) -> Array:
    """Return points on the surface of a capsule along z (n, 3) [m]."""
    points = np.random.default_rng(0).normal(size=(_ON_SPHERE, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    return points + np.outer(np.sign(points[:, 2]) * half, [0.0, 0.0, 1.0])
