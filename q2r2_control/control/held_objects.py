"""What the kernels know while grippers hold something: a model and scratch for each set of grippers that do.

With nothing held the kernels see the cell as if there were no objects at all. Who picks something up has it touch the
table already, or it is drawn larger than it is: no pair may ask for more room than there is. So

- a pair that appears keeps  d - S - buffer,  or its own distance where that is less: d is the pair's distance at the
  reference, and the certified stop brings it no closer than d - S (``S``: stop_certificate.py). Hence the stop at hand
  is proven with the object too, whatever the arms do at that moment, and an object never has to be refused;
- what it keeps grows to the same value for the d and S of later, up to the pair's own distance, and never falls. The
  stop at hand keeps it by the same bound, so the invariant holds with the greater distance.

Pairs that go when a gripper lets go can only make room. Two objects that overlap when the second one is gripped are one
that both hands hold: then they are not watched against each other, until one lets go.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.geometry.collision import BodyPlacements, CollisionBodies, Pairs, bodies_of, pairs_of
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.jit import KernelPointer, pointer_to
from q2r2_control.control.kernel_data import KernelData
from q2r2_control.control.kernel_model import KernelModel, stop_buffer
from q2r2_control.control.safety.provable_distances import provable_distances
from q2r2_control.control.safety.safety_data import ActiveBounds, Rollout, SafetyData, SeparationRows
from q2r2_control.control.safety.safety_model import SafetyModel
from q2r2_control.control.safety.velocity_bounds import BodyVelocities
from q2r2_control.errors import RobotError
from q2r2_control.robot.kept_distances import KeptDistances, kept_by_objects
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_PERIOD = 0.01  # after which kept distances are looked at again, while they grow [s]

AnyArray = npt.NDArray[Any]
# Which pairs of objects count: a pair does where all arms that have to hold are in one of these sets.
_Counting = frozenset[frozenset[str]]


@dataclass(frozen=True, slots=True)
class HeldObjectModels:
    """The kernels' model and data while some objects are held. State, rows and tasks are the same arrays in all."""

    model: KernelPointer
    data: KernelPointer
    safety: SafetyModel
    measured: SafetyData
    objects: IntArray  # numbers, among all pairs of objects, of those that count; the last pairs of the model


class ObjectLoads:
    """Which objects are held, and what their pairs keep."""

    def __init__(self, robot: Robot, settings: ControllerSettings, model: KernelModel) -> None:
        objects = robot.objects
        self._robot = robot
        self._arms, self._holders = tuple(objects.by_arm), objects.holders
        self._goal: KeptDistances = kept_by_objects(robot, settings)
        self._buffer = stop_buffer(self._goal.values, settings)
        self._kept = self._goal.values.copy()  # of every pair of an object, now [m]
        self._due = 0.0
        self.holding: frozenset[str] = frozenset()
        self.growing = False  # whether some pair that counts keeps less than its own distance yet
        self.pair_names = objects.pair_names()
        if self._arms:
            bodies, self._pairs = _with_objects(robot, model.safety)
            count = len(model.safety.collision.bodies.joint)
            model = _with_bodies(model, CollisionBodies._make(array[:count] for array in bodies))
        self.model, self.data = model, KernelData.empty(model)
        self.bodies = model.safety.collision.bodies
        self._loads: dict[_Counting, HeldObjectModels] = {}
        if self._arms:
            self.bodies = bodies
            self._make_room(len(model.safety.min_distance) + len(self._holders), len(robot.joint_names))
        none: IntArray = np.zeros(0, dtype=np.int64)
        self._nothing = HeldObjectModels(
            pointer_to(self.model), pointer_to(self.data), self.model.safety, self.data.safety, none
        )
        for counting in _every_counting(self._arms):
            self._loads[counting] = self._load(counting)
        self.load = self._nothing

    def set_holding(self, arm: str, holds: bool) -> bool:
        """Take it that an arm's gripper holds its object, or does not; whether that is new.

        A pair that begins to count has to :meth:`begin` then, once it was measured with the new :attr:`load`. Raises
        :class:`RobotError` for an arm that has no object.
        """
        if arm not in self._arms:
            allowed = ", ".join(self._arms) or "none"
            raise RobotError(f"holding of arm {arm!r:.40}: its gripper has no object; those that have one: {allowed}")
        if holds == (arm in self.holding):
            return False
        self.holding = self.holding | {arm} if holds else self.holding - {arm}
        before = set(self.load.objects.tolist())
        self._count(frozenset([*(frozenset({held}) for held in self.holding), self.holding]))
        self._new = np.array([pair not in before for pair in self.load.objects.tolist()], dtype=np.bool_)
        return True

    def clear(self) -> None:
        """Nothing is held."""
        self.holding, self.load, self.growing = frozenset(), self._nothing, False

    def begin(self) -> bool:
        """Let the pairs that have begun to count keep what they can; whether those that count have changed by that."""
        if not self._new.any():
            return False
        now, pairs = self._within_reach(), self.load.objects
        both = np.array([len(self._holders[pair]) > 1 for pair in pairs], dtype=np.bool_)
        self._kept[pairs[self._new]] = np.minimum(self._goal.values[pairs], now)[self._new]
        allowed = np.minimum(self._goal.values[pairs], 0.0)
        is_one = bool((self._distances() < allowed)[both & self._new].any())
        if is_one:
            self._count(frozenset(frozenset({held}) for held in self.holding))
        else:
            self._write()
        self._due = 0.0
        return is_one

    def grow(self, h: float) -> None:
        """Let what pairs keep grow, ``h`` [s] after the last time, with the reference and the stop as they are now."""
        self._due -= h
        if self._due > 0.0:
            return
        self._due = _PERIOD
        pairs = self.load.objects
        self._kept[pairs] = np.maximum(self._kept[pairs], np.minimum(self._goal.values[pairs], self._within_reach()))
        self._write()

    def change(self, settings: ControllerSettings) -> None:
        """Let pairs of objects keep what ``settings`` say: less at once, more as :meth:`grow` finds the room."""
        self._goal = kept_by_objects(self._robot, settings)
        self._buffer = stop_buffer(self._goal.values, settings)
        self._kept = np.minimum(self._kept, self._goal.values)
        self._write()

    def write_monitored(self, kept: Array, stop_distance: Array) -> None:
        """Tell the kernels what the other pairs keep, and at what distance they stop in the QP (p,) each [m]."""
        for load in (self._nothing, *self._loads.values()):
            load.safety.min_distance[: len(kept)] = kept
            load.safety.approach.stop_distance[: len(kept)] = stop_distance

    def kept(self) -> Array:
        """What every pair of an object keeps now [m]; minus infinity where it does not count."""
        kept = np.full(len(self._kept), -np.inf)
        kept[self.load.objects] = self._kept[self.load.objects]
        return kept

    def _within_reach(self) -> Array:
        """d - S - buffer of the pairs that count [m]."""
        lasting = provable_distances(self.load.safety, self.load.measured)
        return np.asarray(lasting[len(lasting) - len(self.load.objects) :] - self._buffer[self.load.objects])

    def _distances(self) -> Array:
        """Of the pairs that count, or lower bounds of them [m]."""
        distance = self.load.measured.distance
        return distance[len(distance) - len(self.load.objects) :]

    def _count(self, counting: _Counting) -> None:
        """Let these pairs count and no others; those that did not until now keep their own distance."""
        before = self.load.objects
        self.load = self._loads.get(counting - {frozenset()}, self._nothing)
        appear = np.setdiff1d(self.load.objects, before)
        self._kept[appear] = self._goal.values[appear]
        self._write()

    def _write(self) -> None:
        """Tell the kernels what the pairs keep."""
        pairs = self.load.objects
        kept, safety = self._kept[pairs], self.load.safety
        first = len(safety.min_distance) - len(pairs)
        safety.min_distance[first:] = kept
        safety.approach.stop_distance[first:] = kept + self._buffer[pairs]
        self.growing = bool((kept < self._goal.values[pairs]).any())

    def _make_room(self, pairs: int, nv: int) -> None:
        """Rows for all pairs."""
        safety = self.data.safety._replace(rows=SeparationRows.empty(pairs, nv), active=ActiveBounds.empty(pairs, nv))
        self.data = self.data._replace(safety=safety)

    def _load(self, counting: _Counting) -> HeldObjectModels:
        numbers = [pair for pair, holders in enumerate(self._holders) if holders in counting]
        objects: IntArray = np.array(numbers, dtype=np.int64)
        base, goal = self.model.safety, self._goal
        pairs = Pairs._make(array[objects] for array in self._pairs)
        approach = base.approach._replace(
            stop_distance=_joined(base.approach.stop_distance, (goal.values + self._buffer)[objects]),
            contact_speed=_joined(base.approach.contact_speed, goal.contact_speed[objects]),
            contact_zone=_joined(base.approach.contact_zone, np.zeros(len(objects))),
        )
        collision = base.collision._replace(bodies=self.bodies, pairs=_joined_pairs(base.collision.pairs, pairs))
        safety = base._replace(
            collision=collision, approach=approach, min_distance=_joined(base.min_distance, goal.values[objects])
        )
        measured = self.data.safety._replace(
            collision=self.data.safety.collision._replace(posed=BodyPlacements.empty(self.bodies)),
            velocities=BodyVelocities.empty(collision),
            distance=np.zeros(len(safety.min_distance)),
            near=np.zeros(len(safety.min_distance), dtype=np.int64),
            rollout=Rollout.empty(collision),
        )
        model, data = self.model._replace(safety=safety), self.data._replace(safety=measured)
        return HeldObjectModels(pointer_to(model), pointer_to(data), safety, measured, objects)


def _every_counting(arms: tuple[str, ...]) -> list[_Counting]:
    """Whatever can be held: by one arm, by several, with and without the objects' own pairs."""
    single = [frozenset({arm}) for arm in arms]
    found = [frozenset({one}) for one in single]
    if len(arms) > 1:
        found += [frozenset(single), frozenset([*single, frozenset(arms)])]
    return found


def _with_objects(robot: Robot, safety: SafetyModel) -> tuple[CollisionBodies, Pairs]:
    """The model's bodies and after them those of objects, and all pairs of objects."""
    known, first_body = safety.collision, robot.collision_model.ngeoms
    bodies = bodies_of(robot.objects.geometry)
    travel = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
    every = pairs_of(robot.objects.geometry, known.chain, bodies, travel)
    pairs = Pairs._make(array[len(every.first) - len(robot.objects.holders) :] for array in every)
    # The model's own bodies may end with boxes that it has rounded.
    shift = len(known.bodies.joint) - first_body
    for numbers in (pairs.first, pairs.second):
        numbers[numbers >= first_body] += shift
    joined = (_joined(old, new[first_body:]) for old, new in zip(known.bodies, bodies, strict=True))
    return CollisionBodies._make(joined), pairs


def _with_bodies(model: KernelModel, bodies: CollisionBodies) -> KernelModel:
    safety = model.safety
    return model._replace(safety=safety._replace(collision=safety.collision._replace(bodies=bodies)))


def _joined_pairs(first: Pairs, second: Pairs) -> Pairs:
    width = max(first.joint.shape[1], second.joint.shape[1])
    return Pairs._make(_joined(_widened(a, width), _widened(b, width)) for a, b in zip(first, second, strict=True))


def _widened(array: AnyArray, width: int) -> AnyArray:
    """Rows with zeros at their ends."""
    return array if array.ndim == 1 else np.pad(array, ((0, 0), (0, width - array.shape[1])))


def _joined(first: AnyArray, second: AnyArray) -> AnyArray:
    return np.concatenate([first, second])
