"""Which monitored pairs can meet at all inside the joint limits, found by sampling, and the SRDF that says so.

A sample shows that two bodies can come near, never that they cannot. Where none does, the nearest postures found are
followed downhill. A pair is out of reach only if it stays farther apart than a clearance well above what is kept.
"""

from __future__ import annotations

import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize

from q2r2_control.errors import RobotError
from q2r2_control.robot.pairs import distance_gradient, link_of, pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

# Told how far a search has got: what it does, how much of it is done, how much there is.
Progress = Callable[[str, int, int], None]

_STARTS = 8  # nearest samples of each pair that are followed downhill
_STEPS = 30


@dataclass(frozen=True, slots=True)
class PairReach:
    """How near two links can come."""

    link_a: str
    link_b: str
    nearest: float  # least distance found [m]


def nearest_approaches(
    robot: Robot, samples: int, seed: int, clearance: float, progress: Progress | None = None
) -> list[PairReach]:
    """Least distance found of every monitored pair of links, nearest first; ``samples`` postures are looked at.

    The search for a pair ends where it is no more than ``clearance`` [m]. ``progress`` is called often. Raises
    :class:`RobotError` for fewer than 100 samples.
    """
    if samples < 100:
        raise RobotError(f"samples = {samples}: allowed: 100 or more")
    lower, upper = robot.position_lower, robot.position_upper
    postures = np.random.default_rng(seed).uniform(lower, upper, (samples, robot.model.nv))
    names = pair_names(robot.collision_model)
    distances = np.zeros((samples, len(names)))
    for i, q in enumerate(postures):
        distances[i] = robot.distance_values(q)
        if progress is not None:
            progress("random postures", i + 1, samples)
    nearest: dict[tuple[str, str], float] = {}
    for p, (a, b) in enumerate(names):
        starts = np.argsort(distances[:, p])[:_STARTS]
        least = float(distances[starts[0], p])
        for i in starts:
            if least <= clearance:
                break
            least = min(least, _downhill(robot, p, postures[i]))
        links = (link_of(a), link_of(b))
        nearest[links] = min(nearest.get(links, np.inf), least)
        if progress is not None:
            progress("pairs followed downhill", p + 1, len(names))
    return sorted((PairReach(a, b, d) for (a, b), d in nearest.items()), key=lambda pair: pair.nearest)


def srdf_of(robot: Robot, approaches: Sequence[PairReach], clearance: float, samples: int) -> str:
    """SRDF text that disables links which never come nearer than ``clearance`` [m], or overlap by construction."""
    comment = (
        f"Found by looking at {samples} random postures inside the joint limits and going downhill from the "
        f"nearest ones: these links stay more than {1e3 * clearance:g} mm apart, or overlap by construction."
    )
    overlapping = dict.fromkeys((link_of(a), link_of(b)) for a, b in robot.ignored_pairs)
    never = ((pair.link_a, pair.link_b) for pair in approaches if pair.nearest > clearance)
    pairs = [*((a, b, "Always") for a, b in overlapping), *((a, b, "Never") for a, b in never)]
    return srdf_text(robot.name, comment, pairs)


def srdf_text(name: str, comment: str, pairs: Iterable[tuple[str, str, str]], links: Iterable[str] = ()) -> str:
    """SRDF text that disables ``links``, and ``pairs`` of links with the reason, in MoveIt's words."""
    root = ET.Element("robot", name=name)
    root.append(ET.Comment("\n    " + "\n    ".join(textwrap.wrap(comment, 112)) + "\n  "))
    for link in links:
        ET.SubElement(root, "disable_default_collisions", link=link)
    for a, b, reason in pairs:
        ET.SubElement(root, "disable_collisions", link1=a, link2=b, reason=reason)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _downhill(robot: Robot, p: int, q: Array) -> float:
    """Least distance of pair ``p`` going downhill from ``q`` inside the limits."""
    data, geometry_data = robot.model.createData(), robot.collision_model.createData()

    def distance(posture: Array) -> tuple[float, Array]:
        pin.computeJointJacobians(robot.model, data, posture)
        pin.updateGeometryPlacements(robot.model, data, robot.collision_model, geometry_data)
        found = pin.computeDistance(robot.collision_model, geometry_data, p)
        gradient = distance_gradient(robot.model, data, robot.collision_model, geometry_data, p)
        return float(found.min_distance), gradient

    bounds = list(zip(robot.position_lower, robot.position_upper, strict=True))
    options = {"maxiter": _STEPS}
    return float(minimize(distance, q, method="L-BFGS-B", jac=True, bounds=bounds, options=options).fun)
