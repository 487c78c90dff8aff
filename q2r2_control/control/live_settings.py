"""Settings of a controller that change while it moves: distances that pairs keep, and gains.

**Distances.** A greater one makes a state uncertified that was certified. So a pair keeps more only as far as the stop
at hand is proven with it: never more than  d - S - buffer,  with the pair's distance d at the reference and the bound S
of how much closer the stop brings it (stop_certificate.py). What a pair keeps

- falls at once, when less is asked for: what was proven stays proven;
- grows at ``GROWTH`` towards what is asked for, and no farther than that bound, before a step is decided on. So the
  step is proven with the greater distance, and the invariant of safety/README.md holds at every tick;
- never falls while it grows. A pair that is nearer than asked for is not pushed apart: it keeps the room that it has,
  and more when it gets more. It holds up no motion that opens it.

After a reset pairs keep at once what the posture leaves them of what was asked for later, and what the controller
was made with in any case: out of a start nearer than that it recovers, as without any change.

**Gains** and weights go to their new values on a straight line, so that what a tool is asked for does not jump. Speeds
and accelerations stay within the limits of joints whatever they are. The gain of separation is one of them: it says how
briskly pairs may close in, and the certificate, which keeps them apart, does not read it (safety/separation_rows.py).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.held_objects import ObjectPairs
from q2r2_control.control.kernel_model import KernelData, KernelModel, stop_buffer
from q2r2_control.control.safety.safety_data import provable_distances
from q2r2_control.control.tasks.task_data import task_model_of
from q2r2_control.robot.kept_distances import kept_distances, too_close_at_home
from q2r2_control.robot.pairs import CLEARANCE
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

GROWTH = 0.05  # of what a pair keeps [m/s]
_PERIOD = 0.01  # between two looks at distances that grow [s]
_RAMP_TIME = 0.5  # of gains [s]


class LiveSettings:
    """What of one controller's settings is in force, on its way to what was asked for."""

    def __init__(
        self, robot: Robot, settings: ControllerSettings, model: KernelModel, data: KernelData, objects: ObjectPairs
    ) -> None:
        self._robot, self._objects = robot, objects
        self._safety, self._data = model.safety, data.safety
        self._gains = LiveGains(robot, model, settings)
        self._goal = self._least = kept_distances(robot, settings).values  # least: without any change
        self._growing, self._due = False, 0.0
        self.settings = settings
        self.kept = self._goal  # by every monitored pair now (p,) [m]; another array whenever something has changed

    @property
    def narrow(self) -> int:
        """The pair that keeps the least of what it was asked for, or -1 where all keep all of it."""
        return int(np.argmax(self._goal - self.kept)) if self._growing else -1

    def change(self, settings: ControllerSettings) -> str | None:
        """Go to ``settings``, which differ in ``LIVE`` only; returns why not, and changes nothing then, or None."""
        before, goal = self.settings.min_distance, kept_distances(self._robot, settings)
        if settings.min_distance > before:
            if settings.min_distance > CLEARANCE:
                return (
                    f"min_distance = {settings.min_distance:g} m: allowed while a controller runs: up to "
                    f"{CLEARANCE:g}, since pairs that always stay farther apart are not watched"
                )
            # Arms at home then keep all of it, and rest.
            room = replace(goal, values=goal.values + stop_buffer(goal.values, settings))
            if faults := too_close_at_home(self._robot, room):
                return f"min_distance = {settings.min_distance:g} m: {faults[0]} with distance_buffer"
        self.settings = settings
        self._goal, self._due = goal.values, 0.0
        self._write(np.minimum(self.kept, self._goal))
        self._objects.change(settings)
        self._gains.aim(settings)
        return None

    def restart(self) -> None:
        """Before a reset is observed: begin with what does not depend on where that is."""
        self._due = 0.0
        if self._growing:
            self._write(np.minimum(self._goal, self._least))
        self._gains.finish()

    def begin(self) -> None:
        """After a reset was observed: keep what the posture allows."""
        self._grow(np.inf)

    def step(self, h: float) -> None:
        """Before a step of ``h`` [s] from an observed reference."""
        self._gains.step(h)
        if self._growing:
            self._due -= h
            if self._due <= 0.0:
                self._due = _PERIOD
                self._grow(GROWTH * max(_PERIOD, h))

    def _grow(self, most: float) -> None:
        """Keep more, by at most ``most`` [m], where the stop at hand proves it."""
        if self._growing:
            lasting = provable_distances(self._safety, self._data)[: len(self._goal)]
            room = lasting - stop_buffer(self._goal, self.settings)
            self._write(np.maximum(self.kept, np.minimum(np.minimum(self._goal, self.kept + most), room)))

    def _write(self, kept: Array) -> None:
        self._growing = bool((kept < self._goal).any())
        if not np.array_equal(kept, self.kept):
            self.kept = kept
            self._safety.min_distance[: len(kept)] = kept
            self._safety.approach.stop_distance[: len(kept)] = kept + stop_buffer(kept, self.settings)


class LiveGains:
    """The kernels' gains, speeds and weights: what ``KernelModel.live`` says."""

    def __init__(self, robot: Robot, model: KernelModel, settings: ControllerSettings) -> None:
        self._robot, self._model = robot, model
        self._goal, self._left = self._live_of(settings), 0.0

    def _live_of(self, settings: ControllerSettings) -> tuple[Array, ...]:
        tasks = task_model_of(self._robot, settings, self._model.tasks.chain)
        return (*tasks.live, np.array([settings.separation_gain]))

    def aim(self, settings: ControllerSettings) -> None:
        goal = self._live_of(settings)
        if not all(np.array_equal(values, before) for values, before in zip(goal, self._goal, strict=True)):
            self._goal, self._left = goal, _RAMP_TIME

    def finish(self) -> None:
        if self._left:
            self.step(self._left)

    def step(self, h: float) -> None:
        if not self._left:
            return
        share, self._left = min(h / self._left, 1.0), max(self._left - h, 0.0)
        for values, goal in zip(self._model.live, self._goal, strict=True):
            values[:] = goal if share == 1.0 else values + share * (goal - values)
