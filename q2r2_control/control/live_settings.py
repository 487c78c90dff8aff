"""Change distances, held objects and gains while a controller runs.

**Distances.** The known stop is the stop that was certified last (safety_filter.py). If the required distance of a pair
became greater at once, the known stop could lose its certificate. The distance that a pair keeps therefore grows only
as far as the known stop is certified with it. This bound is d - S - buffer,  where d is the distance of the pair at the
reference, and S is an upper bound on how much the known stop reduces this distance (stop_certificate.py). The kept
distance of a pair

- falls at once if the requested distance is smaller, since the known stop stays certified;
- grows at ``GROWTH`` towards the requested distance, up to the bound, before a step is decided on. The step is then
  certified with the greater distance, and the invariant of safety/README.md holds at every tick;
- does not fall if the bound falls below it. A pair that is nearer than the requested distance is not pushed apart.

After a reset, each pair keeps the distance of the controller's first settings, or the requested distance if that is
smaller. If the requested distance is greater, the pair keeps at once as much of it as the posture allows. If a pair
starts closer than its kept distance, the controller recovers until the pair has its whole buffer. If a pair starts
within the buffer, its buffer is reduced, but not below ``LEAST_BUFFER``, so that the QP stops the pair where it is. The
buffer of this pair then grows with d - S as above. Arms that rest within the buffer are not pushed apart.

**Held objects.** A pair of an object counts only while the object is held; otherwise its kept distance is minus
infinity. When an object is gripped, each of its pairs keeps d - S - buffer, or the distance of its class if that is
less. The known stop is then certified with the object too, so that the object never has to be refused. The kept
distance grows with later values of d and S, and never falls. If two objects overlap when the second object is gripped,
it is assumed that both grippers hold the same object. Its two bodies are not kept apart until one of the grippers
releases it.

**Gains** and weights change linearly to their new values. All arrays of the tasks that differ between the old and the
new settings change in this way, and so does the gain of the separation rows. The certificate does not depend on them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.kernel_model import LEAST_BUFFER, KernelData, KernelModel, stop_buffer
from q2r2_control.control.safety.safety_data import ROUNDING, provable_distances
from q2r2_control.control.tasks.built_in import task_model_of
from q2r2_control.errors import RobotError, shown
from q2r2_control.robot.kept_distances import kept_by_objects, kept_distances, too_close_at_home
from q2r2_control.robot.pairs import CLEARANCE
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

GROWTH = 0.05  # Speed at which a kept distance grows [m/s].
_PERIOD = 0.01  # Time between two updates of distances that grow [s].
_RAMP_TIME = 0.5  # Time in which gains change [s].


class ObjectPairs:
    """The objects that are held, and the distances that their pairs keep. Arrays contain only the objects' pairs."""

    def __init__(self, robot: Robot, settings: ControllerSettings, model: KernelModel, data: KernelData) -> None:
        self._robot, self._safety, self._data = robot, model.safety, data.safety
        self._arms, self._holders = tuple(robot.objects.by_arm), robot.objects.holders
        self._shared = np.array([len(holders) > 1 for holders in self._holders], dtype=np.bool_)
        first = len(robot.collision_model.collisionPairs)
        self._range = slice(first, first + len(self._holders))
        self._aim(settings)
        self.clear()

    def _aim(self, settings: ControllerSettings) -> None:
        self._goal = kept_by_objects(self._robot, settings).values
        self._buffer = stop_buffer(self._goal, settings)

    def clear(self) -> None:
        """Forget all held objects."""
        self.holding: frozenset[str] = frozenset()
        self._due = 0.0
        self._new: npt.NDArray[np.bool_] = np.zeros(len(self._holders), dtype=np.bool_)
        self._write(np.full(len(self._holders), -np.inf))

    def set_holding(self, arm: str, holds: bool) -> bool:
        """Store whether an arm's gripper holds its object; return whether this has changed.

        Pairs that begin to count keep the distance of their class at first. The caller then measures these pairs and
        calls :meth:`begin`.

        Raises:
            RobotError: If the arm has no object.
        """
        if arm not in self._arms:
            allowed = ", ".join(self._arms) or "none"
            raise RobotError(
                f"holding of arm {shown(arm, 40)}: its gripper has no object; those that have one: {allowed}"
            )
        if holds == (arm in self.holding):
            return False
        self.holding = self.holding | {arm} if holds else self.holding - {arm}
        counts = np.array([holders <= self.holding for holders in self._holders], dtype=np.bool_)
        self._new = counts & ~np.isfinite(self.kept)
        self._write(np.where(counts, np.where(self._new, self._goal, self.kept), -np.inf))
        return True

    def begin(self) -> None:
        """Let pairs that have begun to count keep as much distance as is certified.

        The pairs have to be measured before this call.
        """
        kept = np.where(self._new, np.minimum(self._goal, self._within_reach()), self.kept)
        overlap = self._data.distance[self._range] < np.minimum(self._goal, 0.0)
        if (overlap & self._shared & self._new).any():  # Both grippers hold the same object.
            kept[self._shared] = -np.inf
        self._write(kept)
        self._due = 0.0

    def step(self, h: float) -> None:
        """Let kept distances grow, before a step of ``h`` [s]."""
        self._due -= h
        if self._due <= 0.0:
            self._due = _PERIOD
            more = np.maximum(self.kept, np.minimum(self._goal, self._within_reach()))
            self._write(np.where(np.isfinite(self.kept), more, -np.inf))

    def change(self, settings: ControllerSettings) -> None:
        """Let pairs keep the distances of ``settings``: smaller distances at once, greater ones after :meth:`step`."""
        self._aim(settings)
        self._write(np.minimum(self.kept, self._goal))

    def keep_no_more_than(self, kept: Array) -> None:
        """Let pairs keep no more than the earlier distances ``kept`` [m], because a later step was undone."""
        self._write(np.where(np.isfinite(kept), np.minimum(self.kept, kept), self.kept))

    def _within_reach(self) -> Array:
        """Return the greatest distance that each of the objects' pairs may keep now [m].

        It is d - S - buffer, see the module's docstring.
        """
        return np.asarray(provable_distances(self._safety, self._data)[self._range] - self._buffer)

    def _write(self, kept: Array) -> None:
        """Write the kept distances for the kernels [m]; minus infinity for pairs that do not count."""
        self.kept = kept
        self._safety.min_distance[self._range] = kept
        self._safety.approach.stop_distance[self._range] = kept + self._buffer
        self.growing = bool((np.isfinite(kept) & (kept < self._goal)).any())


class LiveSettings:
    """The present settings of one controller, which change gradually to the requested settings."""

    def __init__(
        self, robot: Robot, settings: ControllerSettings, model: KernelModel, data: KernelData, objects: ObjectPairs
    ) -> None:
        self._robot, self._objects = robot, objects
        self._model, self._safety, self._data = model, model.safety, data.safety
        # The final values of the gains, and the time until the gains have these values [s].
        self._gains, self._ramp = self._gains_of(settings), 0.0
        self._changing: list[tuple[Array, Array]] = []  # Arrays that kernels read, and their new values.
        # Distances that pairs have to keep according to the requested settings and to the first settings (p,) [m].
        self._goal = self._least = kept_distances(robot, settings).values
        self._stops = model.safety.approach.stop_distance[: len(self._goal)]  # Distances at which the QP stops pairs.
        # Growing: some kept distance is below the requested one. Crowded: some pair is within its buffer. Due: the time
        # until distances and buffers grow again [s].
        self._growing, self._crowded, self._due = False, False, 0.0
        self.settings = settings
        self.kept = self._goal  # Distance that every monitored pair keeps (p,) [m]. Each change makes a new array.

    @property
    def narrow(self) -> int:
        """The pair whose kept distance is farthest below its requested distance; -1 if no kept distance is below it."""
        return int(np.argmax(self._goal - self.kept)) if self._growing else -1

    def change(self, settings: ControllerSettings) -> str | None:
        """Change to ``settings``, which may change only what ``LIVE`` names; return None, or why they are refused."""
        before, goal = self.settings.min_distance, kept_distances(self._robot, settings)
        if settings.min_distance > before:
            if settings.min_distance > CLEARANCE:
                return (
                    f"min_distance = {settings.min_distance:g} m: allowed while a controller runs: up to "
                    f"{CLEARANCE:g}, since pairs that always stay farther apart are not watched"
                )
            # If the pairs have this much distance at home, arms that rest at home keep the new distance and its buffer.
            room = replace(goal, values=goal.values + stop_buffer(goal.values, settings))
            if faults := too_close_at_home(self._robot, room):
                return f"min_distance = {settings.min_distance:g} m: {faults[0]} with distance_buffer"
        self.settings = settings
        self._goal, self._due = goal.values, 0.0
        self._write(np.minimum(self.kept, self._goal))
        self._objects.change(settings)
        gains = self._gains_of(settings)
        if not all(map(np.array_equal, gains, self._gains)):
            now = arrays_in((self._model.tasks, self._safety.approach.gain))
            self._gains, self._ramp = gains, _RAMP_TIME
            self._changing = [pair for pair in zip(now, gains, strict=True) if not np.array_equal(*pair)]
        return None

    def restart(self) -> None:
        """Before a reset, set kept distances that do not depend on the posture, and finish the change of gains."""
        self._due = 0.0
        self._write(np.minimum(self._goal, self._least))
        self._stops[:] = self.kept + stop_buffer(self.kept, self.settings)
        self._approach_gains(self._ramp)

    def begin(self) -> None:
        """After the reset, let pairs keep as much distance as the posture allows.

        Pairs that are within their buffer get a smaller buffer.
        """
        self._grow(np.inf)
        distance = self._data.distance[: len(self.kept)]
        is_within = (distance >= self.kept - ROUNDING) & (distance < self._stops)
        self._stop_from(np.where(is_within, self.kept, self._stops))

    def step(self, h: float) -> None:
        """Change kept distances and gains before a step of ``h`` [s].

        The distances at the reference have to be computed before this call.
        """
        if self._objects.growing:
            self._objects.step(h)
        if self._ramp:
            self._approach_gains(h)
        if self._growing or self._crowded:
            self._due -= h
            if self._due <= 0.0:
                self._due = _PERIOD
                self._grow(GROWTH * max(_PERIOD, h))
                self._stop_from(self._stops)

    def keep_no_more_than(self, kept: Array) -> None:
        """Let pairs keep no more than the earlier distances ``kept`` (p,) [m], because a later step was undone."""
        self._write(np.minimum(self.kept, kept))

    def _grow(self, most: float) -> None:
        """Let kept distances grow by at most ``most`` [m], as far as the known stop is certified with them."""
        if self._growing:
            room = self._lasting() - stop_buffer(self._goal, self.settings)
            self._write(np.maximum(self.kept, np.minimum(np.minimum(self._goal, self.kept + most), room)))

    def _write(self, kept: Array) -> None:
        self._growing = bool((kept < self._goal).any())
        if not np.array_equal(kept, self.kept):
            self.kept = kept
            self._safety.min_distance[: len(kept)] = kept
            self._stop_from(self._stops)

    def _stop_from(self, before: Array) -> None:
        """Set the distances at which the QP stops the pairs.

        Such a distance is the pair's kept distance plus its buffer, or less if the pair is within its buffer already.
        ``before`` (p,) are the distances so far [m]. A new distance is smaller only if the kept distance plus buffer is
        smaller.
        """
        wanted = self.kept + stop_buffer(self.kept, self.settings)
        least = np.maximum(before, self.kept + LEAST_BUFFER)
        self._stops[:] = np.minimum(np.maximum(self._lasting(), least), wanted)
        self._crowded = bool((self._stops < wanted).any())

    def _lasting(self) -> Array:
        """Return the distance that each monitored pair provably keeps during the known stop (p,) [m].

        It is d - S, see the module's docstring.
        """
        return provable_distances(self._safety, self._data)[: len(self._goal)]

    def _gains_of(self, settings: ControllerSettings) -> tuple[Array, ...]:
        tasks = task_model_of(self._robot, settings, self._model.tasks.chain)
        return tuple(arrays_in((tasks, np.array([settings.separation_gain]))))

    def _approach_gains(self, h: float) -> None:
        share, self._ramp = min(h / self._ramp, 1.0) if self._ramp else 1.0, max(self._ramp - h, 0.0)
        for values, goal in self._changing:
            values[:] = goal if share == 1.0 else values + share * (goal - values)


def arrays_in(values: tuple[Any, ...]) -> Iterator[Array]:
    """Yield all arrays in a tuple and in the tuples within it."""
    for value in values:
        if isinstance(value, tuple):
            yield from arrays_in(value)
        elif isinstance(value, np.ndarray):
            yield value
