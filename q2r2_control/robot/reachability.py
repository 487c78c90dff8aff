"""Which monitored pairs can meet at all inside the joint limits, found by sampling, and the SRDF that says so.

A sample only shows that two bodies can come near, never that they cannot. So the nearest postures found of each pair
are followed downhill, and a pair counts as out of reach only if it stays farther apart than a clearance well above the
distance that the controller keeps.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.optimize import minimize

from q2r2_control.errors import RobotError
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_STARTS = 8  # nearest samples of each pair that are followed downhill
_STEPS = 30


@dataclass(frozen=True, slots=True)
class PairReach:
    """How near two links can come."""

    link_a: str
    link_b: str
    nearest: float  # least distance found [m]


def nearest_approaches(robot: Robot, samples: int, seed: int) -> list[PairReach]:
    """Least distance found of every monitored pair of links, nearest first; ``samples`` postures are looked at.

    Raises :class:`RobotError` for fewer than 100 samples.
    """
    if samples < 100:
        raise RobotError(f"samples = {samples}: allowed: 100 or more")
    search = _Search(robot, np.random.default_rng(seed))
    postures = search.random.uniform(robot.position_lower, robot.position_upper, (samples, robot.model.nv))
    distances = np.array([search.all_distances(q) for q in postures]).reshape(samples, -1)
    nearest: dict[tuple[str, str], float] = {}
    for p, (a, b) in enumerate(pair_names(robot.collision_model)):
        starts = np.argsort(distances[:, p])[:_STARTS]
        least = float(distances[starts[0], p])
        if least > 0.0:
            least = min(search.downhill(p, postures[i]) for i in starts)
        links = (link_of(a), link_of(b))
        nearest[links] = min(nearest.get(links, np.inf), least)
    return sorted((PairReach(a, b, d) for (a, b), d in nearest.items()), key=lambda pair: pair.nearest)


def srdf_of(robot: Robot, approaches: Sequence[PairReach], clearance: float, samples: int) -> str:
    """SRDF text that disables links which never come nearer than ``clearance`` [m], or overlap by construction."""
    root = ET.Element("robot", name=robot.name)
    root.append(
        ET.Comment(
            f" Found by looking at {samples} random postures inside the joint limits and going downhill from the "
            f"nearest ones: these links stay more than {1e3 * clearance:g} mm apart, or overlap by construction. "
        )
    )
    for a, b in dict.fromkeys((link_of(a), link_of(b)) for a, b in robot.ignored_pairs):
        ET.SubElement(root, "disable_collisions", link1=a, link2=b, reason="Default")
    for pair in approaches:
        if pair.nearest > clearance:
            ET.SubElement(root, "disable_collisions", link1=pair.link_a, link2=pair.link_b, reason="Never")
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


class _Search:
    """Pinocchio's models of one robot, and random steps in them."""

    def __init__(self, robot: Robot, random: np.random.Generator) -> None:
        self.random = random
        self._robot = robot
        self._model, self._geometry = robot.model, robot.collision_model
        self._data, self._geometry_data = self._model.createData(), self._geometry.createData()

    def all_distances(self, q: Array) -> list[float]:
        pin.computeDistances(self._model, self._data, self._geometry, self._geometry_data, q)
        return [result.min_distance for result in self._geometry_data.distanceResults]

    def downhill(self, p: int, q: Array) -> float:
        """Least distance of pair ``p`` going downhill from ``q`` inside the limits."""

        def distance(posture: Array) -> float:
            pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._geometry_data, posture)
            return float(pin.computeDistance(self._geometry, self._geometry_data, p).min_distance)

        bounds = list(zip(self._robot.position_lower, self._robot.position_upper, strict=True))
        return float(minimize(distance, q, method="L-BFGS-B", bounds=bounds, options={"maxiter": _STEPS}).fun)
