"""Limit how far grippers open and close, and find out which of them hold an object.

The certificate treats the fingers of an arm as the volume that they sweep between two openings. This interval of
openings must contain the commanded opening and the present opening. The present opening lies between recently measured
and recently commanded openings. The interval therefore covers all of these, plus a tolerance. A gripper is sent only to
openings in the interval that the controller has accepted. This holds for closing as well, because fingers that turn
reach farther forward as they close.

If the wanted opening lies outside the interval, the gripper moves to the wanted opening in steps. A step is halved if
the certificate fails, and doubled if the certificate holds. A smaller interval counts as soon as it is certified. Until
then the wider interval counts.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from q2r2_control.control.controller import CartesianController
from q2r2_control.types import Interval

# Tolerance for the error of a measured opening and for the overshoot of a finger, as a distance that one finger moves
# [m]. The accepted interval always keeps half of this tolerance as a margin. A noisy measurement therefore does not
# need another interval at every tick.
TOLERANCE = 0.001
_FINEST = 0.0005  # Least step of a finger, and least change for which its bodies are computed again [m].
REMEMBERED = 0.05  # An opening that was measured or commanded counts for at least this time [s].
_PATIENCE = 0.005  # If even the finest step is refused, the gripper asks again after this time [s].
_BELIEVABLE = (-0.2, 1.2)  # Plausible measured openings. A finger may go a little beyond its calibrated ends.


class GripperLimiter:
    """Turns wanted openings into permitted openings, for every arm whose opening is measured.

    The openings of other arms are passed through, because the certificate assumes that their fingers may be anywhere
    between closed and open. After a reset the controller assumes this for all arms, and needs a new limiter.
    """

    def __init__(self, controller: CartesianController, remembered: float = REMEMBERED) -> None:
        """``remembered`` is the longest delay of a gripper behind its command [s]."""
        self._controller = controller
        travels = {name: arm.finger_way for name, arm in controller.robot.arms.items()}
        self._grippers = {name: _Gripper(travel, remembered) for name, travel in travels.items() if travel > 0.0}
        # For each gripper that may not move farther, the names of the two bodies that would come too close.
        self.held: dict[str, tuple[str, str]] = {}
        self.changed = False  # Whether the controller's openings changed in the last tick.

    def limit(self, wanted: Mapping[str, float], measured: Mapping[str, float], now: float) -> dict[str, float]:
        """Return the openings that may be commanded, from 0 for closed to 1 for open.

        Args:
            wanted: The wanted openings by arm.
            measured: The measured openings by arm. Without a plausible measurement, the last permitted opening stays.
            now: The time [s].
        """
        self.changed = False
        granted = dict(wanted)
        for arm, gripper in self._grippers.items():
            # A number outside 0 .. 1 is passed on as it is, because the plant refuses it.
            if arm in wanted and 0.0 <= wanted[arm] <= 1.0:
                if _BELIEVABLE[0] <= measured.get(arm, math.nan) <= _BELIEVABLE[1]:
                    self._go_on(arm, gripper, wanted[arm], measured[arm], now)
                if gripper.granted is not None:
                    granted[arm] = gripper.granted
        return granted

    def resume(self, commanded: Mapping[str, float], measured: Mapping[str, float], now: float) -> None:
        """Begin with grippers that were already ``commanded``, so that closed fingers count as closed at once."""
        for arm, gripper in self._grippers.items():
            if arm in commanded and _BELIEVABLE[0] <= measured.get(arm, math.nan) <= _BELIEVABLE[1]:
                gripper.granted = commanded[arm]
                gripper.note(commanded[arm], measured[arm], now)
                self._controller.set_opening(arm, *gripper.needed())

    def _go_on(self, arm: str, gripper: _Gripper, wanted: float, measured: float, now: float) -> None:
        if gripper.rests(wanted, measured, now):
            return
        rolled = gripper.note(wanted, measured, now)
        if now < gripper.asks_at:
            return
        goal, accepted, refused = gripper.goal(), self._controller.openings[arm], None
        # The request adds only the goal to the accepted interval, and not the measured opening. A gripper that was
        # forced wider than can be certified may therefore still close.
        free = _holds(accepted, gripper.around(goal))
        if not free:
            refused = self._controller.set_opening(arm, *_hull(accepted, gripper.around(goal)))
        elif gripper.worth_asking(accepted, rolled):
            refused = self._controller.set_opening(arm, *_hull(gripper.needed(), gripper.around(goal)))
        gripper.answered(goal, free, refused is None, now)
        self.changed |= self._controller.openings[arm] != accepted
        # If the accepted interval contains all openings that are needed, the gripper does not count as held, although a
        # smaller interval cannot be certified yet.
        if refused is None or (free and _holds(accepted, gripper.needed(0.5))):
            self.held.pop(arm, None)
        else:
            self.held[arm] = refused


class _Gripper:
    """The recent openings of one gripper, and the next step that it may ask for."""

    def __init__(self, travel: float, remembered: float) -> None:
        """``travel``: a finger's motion from closed to open [m]. ``remembered``: see :class:`GripperLimiter`."""
        self._remembered = remembered
        self._tolerance, self._finest = TOLERANCE / travel, min(_FINEST / travel, 1.0)
        self.granted: float | None = None  # The opening that is commanded; None before the first tick.
        self.asks_at = -math.inf
        self._wanted = math.nan
        # Largest difference between the next opening and the commanded one. It is 1 when a new opening is wanted.
        self._step: float
        self._seen: list[Interval] = []  # The openings in the present time span, and in the previous one.
        self._since = -math.inf

    def rests(self, wanted: float, measured: float, now: float) -> bool:
        """Return whether a tick brings no new information, which is so in most ticks.

        The wanted opening is then commanded already, and the measured opening lies in the interval seen so far.
        """
        if not wanted == self._wanted == self.granted or now - self._since >= self._remembered:
            return False
        least, greatest = self._seen[0]
        return least <= measured <= greatest

    def note(self, wanted: float, measured: float, now: float) -> bool:
        """Take the openings of a tick. Return whether a time span has ended; a smaller interval may then be enough."""
        if self.granted is None:
            # Any opening is granted at first, because the certificate still assumes fingers anywhere between closed and
            # open.
            self.granted = wanted
        if wanted != self._wanted:
            self._wanted, self._step, self.asks_at = wanted, 1.0, now
        spread = min(measured, self.granted), max(measured, self.granted)
        rolled = now - self._since >= self._remembered
        if rolled:
            self._seen, self._since = [spread, *self._seen[:1]], now
        else:
            self._seen[0] = _hull(self._seen[0], spread)
        return rolled and len(self._seen) > 1

    def needed(self, share: float = 1.0) -> Interval:
        """Return the interval of openings that the gripper may have now, widened by a share of the tolerance."""
        least, greatest = self._seen[0] if len(self._seen) == 1 else _hull(*self._seen)
        return _hull(self.around(least, share), self.around(greatest, share))

    def around(self, opening: float, share: float = 1.0) -> Interval:
        """Return an interval around an opening, with a share of the tolerance on each side, within 0 .. 1."""
        tolerance = share * self._tolerance
        return min(max(opening - tolerance, 0.0), 1.0), min(max(opening + tolerance, 0.0), 1.0)

    def goal(self) -> float:
        """Return the opening of the next step towards the wanted opening."""
        if self.granted is None or abs(self._wanted - self.granted) <= self._step:
            return self._wanted
        return self.granted + math.copysign(self._step, self._wanted - self.granted)

    def answered(self, goal: float, free: bool, accepted: bool, now: float) -> None:
        """Adapt the step to the controller's answer.

        Args:
            goal: The opening that was asked for.
            free: Whether the goal was in the accepted interval already, so that it needed no answer.
            accepted: Whether the controller accepted the interval.
            now: The time [s].
        """
        if not accepted and (free or self._step <= self._finest):
            self.asks_at = now + _PATIENCE
        if free or accepted:
            self.granted, self._step = goal, min(2.0 * self._step, 1.0)
        else:
            self._step = max(0.5 * self._step, self._finest)

    def worth_asking(self, accepted: Interval, rolled: bool) -> bool:
        """Return whether the accepted interval has to grow, or can shrink by enough to be worth the computation."""
        needed = self.needed()
        if not _holds(accepted, self.needed(0.5)):
            return True
        return rolled and max(needed[0] - accepted[0], accepted[1] - needed[1]) >= self._finest


def _holds(outer: Interval, inner: Interval) -> bool:
    return outer[0] <= inner[0] and inner[1] <= outer[1]


def _hull(first: Interval, second: Interval) -> Interval:
    return min(first[0], second[0]), max(first[1], second[1])


# A finger holds an object if it stays farther open than commanded by more than the first number [m or rad]. If the
# difference falls to the second number, the object has slipped out.
_SQUEEZES, _SLIPPED = 0.002, 0.001
_STILL, STALL = 0.0005, 0.2  # A finger stands still if it moves by at most _STILL [m or rad] in the time STALL [s].
_CLOSED = 0.5  # A gripper without a measured opening counts as closed if it is commanded below this opening.


class GraspWatch:
    """Tells the controller which grippers hold their object, for grippers that have an object in the cell's YAML."""

    def __init__(self, controller: CartesianController, stall: float = STALL) -> None:
        """``stall``: a gripper that is asked to close and stands still for this time holds something [s]."""
        self._controller = controller
        arms = controller.robot.arms
        self._grips = {arm: Grip(arms[arm].stroke, stall) for arm in controller.robot.objects.by_arm}

    def tell_again(self) -> None:
        """Tell a controller that was reset which objects the grippers held before the reset."""
        for arm, grip in self._grips.items():
            if grip.holds:
                self._controller.set_holding(arm, True)

    def update(self, wanted: Mapping[str, float], measured: Mapping[str, float], now: float) -> bool:
        """Update the controller before its step; returns whether a gripper has begun or ceased to hold its object.

        Args:
            wanted: The commanded openings by arm, from 0 for closed to 1 for open.
            measured: The measured openings by arm.
            now: The time [s].
        """
        changed = False
        for arm, grip in self._grips.items():
            if arm in wanted:
                holds = grip.look(wanted[arm], measured.get(arm), now)
                if holds != self._controller.holding[arm]:
                    self._controller.set_holding(arm, holds)
                    changed = True
        return changed


class Grip:
    """Decides from the commanded and the measured openings whether one gripper holds something."""

    def __init__(self, stroke: float, stall: float = STALL) -> None:
        self._stroke, self._stall = stroke, stall
        self.holds = False
        # The opening of the finger when it last moved [m or rad], and the time of this motion [s].
        self._seen, self._since = math.nan, -math.inf

    def look(self, wanted: float, measured: float | None, now: float) -> bool:
        """Return whether the gripper holds something.

        Args:
            wanted: The commanded opening.
            measured: The measured opening; None if this gripper has no measurement.
            now: The time [s].
        """
        if measured is None and math.isnan(self._seen):
            self.holds = wanted < _CLOSED
        elif measured is not None and math.isfinite(measured):
            squeezed, opening = (measured - wanted) * self._stroke, measured * self._stroke
            if squeezed <= _SLIPPED:
                self.holds = False
            if squeezed <= _SQUEEZES or not abs(opening - self._seen) <= _STILL:
                self._seen, self._since = opening, now
            elif now - self._since >= self._stall:
                self.holds = True
        return self.holds
