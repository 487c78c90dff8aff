"""Find by sampling which monitored pairs can meet inside the joint limits, and write the SRDF that excludes the others.

A sample can show that two bodies can come near, but never that they cannot. If no sample shows it, the search descends
along the gradient of the distance from the nearest samples. Two bodies count as unable to meet only if they stay
farther apart than a clearance, which is much greater than the distance that pairs keep.
"""

from __future__ import annotations

import textwrap
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import pinocchio as pin
from scipy.optimize import Bounds, minimize

from q2r2_control.errors import RobotError
from q2r2_control.robot.coal_distances import CoalDistances
from q2r2_control.robot.pairs import distance_gradient, link_of, pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

# A function that is called with the progress of a search. Its arguments are: the name of the present stage; the number
# of its postures or pairs that are done; the number of all its postures or pairs.
Progress = Callable[[str, int, int], None]

# For each pair of bodies, the search keeps this number of random postures, those with the smallest distances. From each
# of them, it descends along the gradient of the distance.
_STARTS = 8
_STEPS = 30  # Greatest number of steps of a descent.
_FLAT = 1e-6  # If the relative progress of a step is smaller than this, the descent ends.
_BATCH, _FEW = 250, 4  # Number of postures in a batch, and number of batches before the first descent for each pair.


@dataclass(frozen=True, slots=True)
class PairReach:
    """The least distance of two links that a search has found."""

    link_a: str
    link_b: str
    nearest: float  # The least distance that was found [m].


def nearest_approaches(
    robot: Robot, samples: int, seed: int, clearance: float, progress: Progress | None = None
) -> list[PairReach]:
    """Return the least distance that was found for every monitored pair of links, the nearest first.

    Args:
        robot: The robot.
        samples: The number of random postures.
        seed: The seed of the random postures.
        clearance: The search for a pair ends when its distance is not greater than this [m].
        progress: A function that is called often during the search.

    Raises:
        RobotError: If there are fewer than 100 samples.
    """
    if samples < 100:
        raise RobotError(f"samples = {samples}: allowed: 100 or more")
    lower, upper = robot.position_lower, robot.position_upper
    postures = np.random.default_rng(seed).uniform(lower, upper, (samples, robot.model.nv))
    search = _Search(robot, clearance)
    for begin in range(0, samples, _BATCH):
        search.look_at(postures[begin : begin + _BATCH])
        if begin == _FEW * _BATCH:
            # Most pairs that can meet are found here, and need no more samples.
            search.go_downhill(1)
        if progress is not None:
            progress("random postures", min(begin + _BATCH, samples), samples)
    search.go_downhill(_STARTS, progress)
    nearest: dict[tuple[str, str], float] = {}
    for (a, b), distance in zip(search.names, search.nearest.tolist(), strict=True):
        links = (link_of(a), link_of(b))
        nearest[links] = min(nearest.get(links, np.inf), distance)
    return sorted((PairReach(a, b, d) for (a, b), d in nearest.items()), key=lambda pair: pair.nearest)


class _Search:
    """Finds the nearest postures of each pair. A pair that has come as near as ``clearance`` [m] is no longer examined.

    On a robot with thousands of pairs, the search for most of them ends after a few hundred postures.
    """

    def __init__(self, robot: Robot, clearance: float) -> None:
        self._model, self._geometry, self._clearance = robot.model, robot.collision_model.copy(), clearance
        self._pairs = [pin.CollisionPair(pair.first, pair.second) for pair in self._geometry.collisionPairs]
        self._bounds = Bounds(robot.position_lower, robot.position_upper)
        self.names = pair_names(self._geometry)
        self.nearest = np.full(len(self.names), np.inf)  # The least distance of each pair so far (pairs,) [m].
        self._left = np.arange(len(self.names))  # The indices of the pairs that are still examined.
        # The postures from which the search descends for each pair, and their distances. The nearest posture is first.
        self._starts = np.zeros((len(self.names), _STARTS, self._model.nv))
        self._at = np.full((len(self.names), _STARTS), np.inf)
        self._distances = CoalDistances(self._model, self._geometry)

    def look_at(self, postures: Array) -> None:
        """Measure the distances at ``postures`` (n, nv), and keep the nearest postures of each pair."""
        distances = np.empty((len(postures), len(self._left)))
        for i, q in enumerate(postures):
            distances[i] = self._distances.at(q)
        for p, column in zip(self._left, distances.T, strict=True):
            found = np.concatenate([self._at[p], column])
            best = np.argsort(found, kind="stable")[:_STARTS]
            self._starts[p] = np.concatenate([self._starts[p], postures])[best]
            self._at[p] = found[best]
            self.nearest[p] = min(self.nearest[p], found[best[0]])
        self._drop_the_near()

    def go_downhill(self, starts: int, progress: Progress | None = None) -> None:
        """Descend from the ``starts`` nearest postures of each pair to smaller distances, inside the limits."""
        for k, p in enumerate(self._left):
            for q in self._starts[p][np.isfinite(self._at[p])][:starts]:
                if self.nearest[p] > self._clearance:
                    self.nearest[p] = min(self.nearest[p], self._downhill(k, q))
            if progress is not None:
                progress("pairs followed downhill", k + 1, len(self._left))
        self._drop_the_near()

    def _downhill(self, k: int, q: Array) -> float:
        """Return the local minimum of a pair's distance that a descent from the posture ``q`` finds [m].

        ``k`` is the pair's index in ``_left``.
        """
        data, geometry_data = self._distances.data, self._distances.geometry_data

        def distance(posture: Array) -> tuple[float, Array]:
            pin.computeJointJacobians(self._model, data, posture)
            pin.updateGeometryPlacements(self._model, data, self._geometry, geometry_data)
            found = pin.computeDistance(self._geometry, geometry_data, k)
            gradient = distance_gradient(self._model, data, self._geometry, geometry_data, k)
            return float(found.min_distance), gradient

        options = {"maxiter": _STEPS, "ftol": _FLAT}
        return float(minimize(distance, q, method="L-BFGS-B", jac=True, bounds=self._bounds, options=options).fun)

    def _drop_the_near(self) -> None:
        self._left = np.flatnonzero(self.nearest > self._clearance)
        self._geometry.removeAllCollisionPairs()
        for p in self._left:
            self._geometry.addCollisionPair(self._pairs[p])
        self._distances = CoalDistances(self._model, self._geometry)


def srdf_of(robot: Robot, approaches: Sequence[PairReach], clearance: float, samples: int) -> str:
    """Return an SRDF that disables links that never come nearer than ``clearance`` [m], or overlap by construction."""
    comment = (
        f"Found by looking at {samples} random postures inside the joint limits and going downhill from the "
        f"nearest ones: these links stay more than {1e3 * clearance:g} mm apart, or overlap by construction."
    )
    overlapping = dict.fromkeys((link_of(a), link_of(b)) for a, b in robot.ignored_pairs)
    never = ((pair.link_a, pair.link_b) for pair in approaches if pair.nearest > clearance)
    pairs = [*((a, b, "Always") for a, b in overlapping), *((a, b, "Never") for a, b in never)]
    return srdf_text(robot.name, comment, pairs)


def srdf_text(name: str, comment: str, pairs: Iterable[tuple[str, str, str]], links: Iterable[str] = ()) -> str:
    """Return an SRDF that disables ``links``, and ``pairs`` of links.

    Each pair has a reason, which is a word that MoveIt uses, such as "Never".
    """
    root = ET.Element("robot", name=name)
    root.append(ET.Comment("\n    " + "\n    ".join(textwrap.wrap(comment, 112)) + "\n  "))
    for link in links:
        ET.SubElement(root, "disable_default_collisions", link=link)
    for a, b, reason in pairs:
        ET.SubElement(root, "disable_collisions", link1=a, link2=b, reason=reason)
    ET.indent(root)
    return '<?xml version="1.0"?>\n' + ET.tostring(root, encoding="unicode") + "\n"
