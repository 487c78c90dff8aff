"""Answers that a model gives by itself about arms, fingers and shapes, before a cell is written for it."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import coal
import numpy as np
from scipy.spatial import ConvexHull

from q2r2_control.errors import ConfigError
from q2r2_control.robot.arm_chain import arm_ends, coupled_joint, default_tip, end_of, is_called_gripper
from q2r2_control.robot.description import Description, LinkTree, joint_end, joint_limits
from q2r2_control.robot.enclose import Capsule, capsules_around, enclose_shapes
from q2r2_control.robot.finger_motion import HARDLY_MOVED, FingerMotion
from q2r2_control.robot.followers import followers_of
from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.pinocchio_models import read_models
from q2r2_control.types import Array

_ARM_NAME = re.compile(r"arm|hand|grip|wrist|elbow|shoulder", re.IGNORECASE)
_SIDE_NAMES = {side: re.compile(rf"{side}|(^|[_-]){side[0]}([_-]|$)", re.IGNORECASE) for side in ("left", "right")}
_LEAST_JOINTS = 3  # Least number of joints of an arm.
_ON_SPHERE = 400  # points of a capsule's ends that are compared with its mesh
_IN_BOX = 20_000  # points that volumes of several capsules are measured by
_SEVERAL = (2, 3)  # capsules that are tried
# Of one capsule's volume, what several may have, and what each more has to save beyond the pairs that it costs.
_CLEARLY_LESS, _EACH_SAVES = 0.8, 0.1
_WIDEST, _STRONGEST, _FASTEST = 3.15, 500.0, 5.0  # that a cell's gripper may have


def tip_of(tree: LinkTree, motion: FingerMotion, key: str) -> str:
    """The last link of the model's arm: the one that leaves no doubt, or that of the only long chain.

    Raises :class:`ConfigError` that begins with ``key`` and names the candidates.
    """
    try:
        return default_tip(tree, (), key, motion)
    except ConfigError:
        if len(tips := _tips(tree, motion, key)) == 1:
            return tips[0]
        raise


def tips_by_side(tree: LinkTree, motion: FingerMotion, key: str) -> dict[str, str]:
    """The last link of each arm of a model that holds both. Raises :class:`ConfigError` as :func:`tip_of` does."""
    tips = _tips(tree, motion, key)
    found = {
        side: [tip for tip in tips if any(map(name.search, tree.path(tip)[-3:]))] for side, name in _SIDE_NAMES.items()
    }
    if any(len(ends) != 1 for ends in found.values()):
        raise ConfigError(f"{key}: no left and right among the ends of its chains: {', '.join(tips) or 'none'}")
    return {side: ends[0] for side, ends in found.items()}


def _tips(tree: LinkTree, motion: FingerMotion, key: str) -> list[str]:
    """Ends of long chains; of arms only, where names tell arms from legs."""
    ends = arm_ends(tree, motion)
    named = [end for end in ends if any(map(_ARM_NAME.search, tree.path(end)))]
    return [end_of(tree, end, key) for end in named or ends]


def check_arm(tree: LinkTree, tip: str, where: str, key: str | None) -> None:
    """Check that enough joints carry ``tip``, and that nothing more of the arm is beyond it.

    Args:
        tree: The links and joints of the model.
        tip: The last link of the arm.
        where: Begins the text of an error.
        key: The option by which a user names the tip; None if the user has named it, so that the arm may end there.

    Raises:
        ConfigError: If it is no arm, with the joints that mimic others, and with links that could be the tip.
    """
    followers = followers_of(tree.joint_to.values())
    coupled = None if key is None else coupled_joint(tree, tip)
    if (count := len(tree.chain(tip))) >= _LEAST_JOINTS and coupled is None:
        return
    but = ""
    if mimics := ", ".join(f"{name} mimics {one.driver}" for name, one in followers.items()):
        but = f"; {mimics:.200}, so that it ends the arm like a gripper's"
    links = [joint_end(joint, "child") for name, joint in tree.movable().items() if name not in followers]
    chains = {link: [joint.get("name", "") for joint in tree.chain(link)] for link in links}
    longer = [link for link in links if len(chains[link]) >= _LEAST_JOINTS and not {*chains[link]} & {*followers}]
    ends = [link for link in longer if not any(link in tree.path(other)[:-1] for other in longer)]
    if key is not None and (ends := ends or ([tip] if count >= _LEAST_JOINTS else [])):
        but += f"; {key} may be {', '.join(ends):.200}"
    raise ConfigError(f"{where}: joints that move {tip}: {count}; allowed: an arm, of {_LEAST_JOINTS} or more{but}")


def lacks_of(description: Description, tree: LinkTree, tip: str) -> tuple[list[str], list[str]]:
    """Limits that joints of the arm lack, and links that move without a mass."""
    limits, masses, links = [], [], description.urdf.findall("link")
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
        body = set(tree.fixed_to(child := joint_end(joint, "child")))
        of_body = [mass for link in links if link.get("name") in body for mass in link.findall("inertial/mass")]
        if not any(float(mass.get("value", "0")) > 0.0 for mass in of_body):
            masses.append(child)
    return limits, masses


@dataclass(frozen=True, slots=True)
class FoundGripper:
    """The joints beyond an arm that open and close a gripper, and how they were found."""

    settings: dict[str, Any]  # Of the cell's YAML; empty if no joints are taken.
    why: str  # Why these joints, and these ends of their travel, are taken.
    others: tuple[str, ...]  # Joints beyond the arm that stay where they are.

    def told(self, tip: str) -> str:
        """Return which joints beyond ``tip`` are taken for a gripper's, why, and which ones stay still."""
        taken, others = (", ".join(joints) for joints in (self.settings.get("joints", ()), self.others))
        kind, still = (
            ("a gripper's", f"; {others:.200} stay still" if others else "") if taken else ("no gripper's", "")
        )
        return f"{taken or others:.200} beyond its tip, {tip}, are taken for {kind} joints: {self.why}{still}"


def gripper_of(tree: LinkTree, motion: FingerMotion, tip: str) -> FoundGripper | None:
    """Find the gripper beyond the last joint that carries ``tip``; None if that joint carries no other one.

    A cell drives all joints of a gripper alike, and so these are joints of one travel. Those are taken that bring tips
    nearest together. If no shape shows that, joints that others mimic, pairs, and names that say gripper are taken.
    """
    last = tree.chain(tip)[-1]
    followers = followers_of(tree.joint_to.values())
    beyond = {
        name: joint
        for name, joint in tree.movable().items()
        if name not in followers
        and joint.get("type") in ("revolute", "prismatic")
        and joint_end(last, "child") in tree.path(joint_end(joint, "parent"))
        and joint is not last
    }
    alike: dict[tuple[str | None, float, float], list[str]] = {}
    for name, joint in beyond.items():
        if (travel := joint_limits(joint))[0] < travel[1]:
            alike.setdefault((joint.get("type"), *travel), []).append(name)
    if not alike:
        return None
    closings = [(joints, motion.closing(joints)) for joints in alike.values()]
    joints, closing = min(closings, key=lambda one: (1.0 if one[1] is None else one[1].share, -len(one[0])))
    why = str(closing)
    if closing is None or closing.share > HARDLY_MOVED:
        drivers = {one.driver for one in followers.values()}
        hints = [
            joints
            for joints in alike.values()
            if len(joints) > 1 or {*joints} & drivers or any(map(is_called_gripper, joints))
        ]
        if not hints:
            return FoundGripper({}, "no shape that they move comes nearer to another", tuple(beyond))
        joints = max(hints, key=len)
        closing = motion.closing(joints)
        why = "no shape shows it, but their names, or that they are a pair; see which end is open"
    lower, upper = joint_limits(beyond[joints[0]])
    closed, opened = (lower, upper) if closing is None else (closing.closed, closing.opened)
    limit = beyond[joints[0]].find("limit")
    speed, force = (0.0 if limit is None else float(limit.get(what, "0")) for what in ("velocity", "effort"))
    settings = {
        "joints": joints,
        "open_position": float(np.clip(opened, -_WIDEST, _WIDEST)),
        "closed_position": float(np.clip(closed, -_WIDEST, _WIDEST)),
        **({"speed": min(speed, _FASTEST)} if speed > 0.0 else {}),
        **({"force": min(force, _STRONGEST)} if force > 0.0 else {}),
    }
    return FoundGripper(settings, why, tuple(name for name in beyond if name not in joints))


@dataclass(frozen=True, slots=True)
class CapsuleFit:
    """The capsule that stands for a mesh, which it holds wholly."""

    link: str
    radius: float  # [m]
    length: float  # of its segment [m]
    beyond: float  # how far it reaches beyond the mesh's convex hull, at least [m]
    wasted: float  # share of its volume that is more than the hull's
    capsules: int  # that hold the mesh together in clearly less volume; 1: one does
    then_wasted: float  # the share that is left with these


def capsule_fits(description: Description, several: Collection[str]) -> list[CapsuleFit]:
    """How well capsules fit the collision meshes of a model, the worst first.

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
        if len(points) <= points.shape[1]:  # a single triangle
            continue
        hull = ConvexHull(points, qhull_options="QJ")  # QJ: flat ones too
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
    """Points on the surface of a capsule along z (n, 3) [m]."""
    points = np.random.default_rng(0).normal(size=(_ON_SPHERE, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    return points + np.outer(np.sign(points[:, 2]) * half, [0.0, 0.0, 1.0])
