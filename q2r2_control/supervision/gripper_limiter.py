"""How far grippers may be opened and closed, and which of them hold an object.

The controller counts the fingers of an arm as what they sweep between two openings. That interval has to hold where the
gripper is and where it may go. It covers the measured and the commanded openings of a moment ago, with a tolerance. A
gripper is commanded to openings in the accepted interval only, opening or closing: fingers that turn reach farther
forward as they close. Others go on in steps that are halved where the certificate fails and doubled where it holds. A
smaller interval counts as soon as it is proven, and until then the wider one, which holds where the gripper is too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from q2r2_control.control.controller import CartesianController
from q2r2_control.types import Interval

# How exactly openings are measured, and how far a finger overshoots, on the way of one finger [m]. Half of it is
# there always, so that a measurement that trembles does not ask at every tick.
TOLERANCE = 0.001
_FINEST = 0.0005  # least step that is asked for, and least change for which bodies are worked out anew [m]
REMEMBERED = 0.05  # what was measured or commanded counts for at least this long [s]
_PATIENCE = 0.005  # after which a gripper that is held at its finest step asks again [s]
_BELIEVABLE = (-0.2, 1.2)  # measured openings; a finger may go a little beyond its calibrated ends


class GripperLimiter:
    """Turns wanted openings into those that may be commanded, for every arm whose opening is measured.

    Others are passed through, and their fingers stay all of their way. To be made anew whenever the controller is
    reset, which begins with all fingers all of their way too.
    """

    def __init__(self, controller: CartesianController, remembered: float = REMEMBERED) -> None:
        """``remembered``: the delay of a gripper that is allowed for [s]."""
        self._controller = controller
        ways = {name: arm.finger_way for name, arm in controller.robot.arms.items()}
        self._grippers = {name: _Gripper(way, remembered) for name, way in ways.items() if way > 0.0}
        self.held: dict[str, tuple[str, str]] = {}  # arm -> pair of bodies that keeps its gripper from going on
        self.changed = False  # whether the controller's openings did, in the last tick

    def limit(self, wanted: Mapping[str, float], measured: Mapping[str, float], now: float) -> dict[str, float]:
        """Openings that may be commanded at ``now`` [s], 0 closed .. 1 open; as before where no measurement counts."""
        self.changed = False
        granted = dict(wanted)
        for arm, gripper in self._grippers.items():
            # A number that is no opening is the plant's to refuse.
            if arm in wanted and 0.0 <= wanted[arm] <= 1.0:
                if _BELIEVABLE[0] <= measured.get(arm, math.nan) <= _BELIEVABLE[1]:
                    self._go_on(arm, gripper, wanted[arm], measured[arm], now)
                if gripper.granted is not None:
                    granted[arm] = gripper.granted
        return granted

    def resume(self, commanded: Mapping[str, float], measured: Mapping[str, float], now: float) -> None:
        """Begin with grippers that were ``commanded`` already: closed fingers take up no more than they do at once."""
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
        # Asked one after the other, so that a gripper that is forced wider than can be proven may still be closed.
        free = _holds(accepted, gripper.around(goal))
        if not free:
            refused = self._controller.set_opening(arm, *_hull(accepted, gripper.around(goal)))
        elif gripper.worth_asking(accepted, rolled):
            refused = self._controller.set_opening(arm, *_hull(gripper.needed(), gripper.around(goal)))
        gripper.answered(goal, free, refused is None, now)
        self.changed |= self._controller.openings[arm] != accepted
        # Less that cannot be proven yet holds no gripper: what was accepted before holds all that is needed.
        if refused is None or (free and _holds(accepted, gripper.needed(0.5))):
            self.held.pop(arm, None)
        else:
            self.held[arm] = refused


class _Gripper:
    """The measured and commanded openings of one gripper, and how far it may ask to go."""

    def __init__(self, way: float, remembered: float) -> None:
        """``way``: of a finger, from closed to open [m]."""
        self._remembered = remembered
        self._tolerance, self._finest = TOLERANCE / way, min(_FINEST / way, 1.0)
        self.granted: float | None = None  # the opening that is commanded
        self.asks_at = -math.inf
        self._wanted = math.nan
        self._step = 1.0
        self._seen: list[Interval] = []  # in this span of time, and in the one before
        self._since = -math.inf

    def rests(self, wanted: float, measured: float, now: float) -> bool:
        """Whether this tick's openings tell nothing new; most ticks' do not."""
        if not wanted == self._wanted == self.granted or now - self._since >= self._remembered:
            return False
        least, greatest = self._seen[0]
        return least <= measured <= greatest

    def note(self, wanted: float, measured: float, now: float) -> bool:
        """Take a tick's openings; whether a span of time has ended, so that less may be needed."""
        if self.granted is None:
            self.granted = wanted  # while fingers are all of their way
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
        """Where the gripper may be, as openings, with a share of the tolerance."""
        least, greatest = self._seen[0] if len(self._seen) == 1 else _hull(*self._seen)
        return _hull(self.around(least, share), self.around(greatest, share))

    def around(self, opening: float, share: float = 1.0) -> Interval:
        """An opening with a share of the tolerance; beyond the ends of the stroke there is nothing."""
        tolerance = share * self._tolerance
        return min(max(opening - tolerance, 0.0), 1.0), min(max(opening + tolerance, 0.0), 1.0)

    def goal(self) -> float:
        """The next opening on the way to the wanted one."""
        if self.granted is None or abs(self._wanted - self.granted) <= self._step:
            return self._wanted
        return self.granted + math.copysign(self._step, self._wanted - self.granted)

    def answered(self, goal: float, free: bool, accepted: bool, now: float) -> None:
        """Learn from the answer to what was asked; a ``free`` goal needed none."""
        if not accepted and (free or self._step <= self._finest):
            self.asks_at = now + _PATIENCE
        if free or accepted:
            self.granted, self._step = goal, min(2.0 * self._step, 1.0)
        else:
            self._step = max(0.5 * self._step, self._finest)

    def worth_asking(self, accepted: Interval, rolled: bool) -> bool:
        """Whether the bodies have to grow, or may shrink by as much as is worth the work."""
        needed = self.needed()
        if not _holds(accepted, self.needed(0.5)):
            return True
        return rolled and max(needed[0] - accepted[0], accepted[1] - needed[1]) >= self._finest


def _holds(outer: Interval, inner: Interval) -> bool:
    return outer[0] <= inner[0] and inner[1] <= outer[1]


def _hull(first: Interval, second: Interval) -> Interval:
    return min(first[0], second[0]), max(first[1], second[1])


# How much farther open than asked each finger is that holds something, and that does not any more [m or rad].
_SQUEEZES, _SLIPPED = 0.002, 0.001
_STILL, STALL = 0.0005, 0.2  # a finger that moves by less than this in that time is held up [m or rad], [s]
_CLOSED = 0.5  # a gripper that is not measured is taken as closed below this opening


class GraspWatch:
    """Tells the controller which grippers hold their objects, of those that have one in the cell's YAML."""

    def __init__(self, controller: CartesianController, stall: float = STALL) -> None:
        """``stall``: after which a gripper that was told to close and stands still is held up [s]."""
        self._controller = controller
        arms = controller.robot.arms
        self._grips = {arm: Grip(arms[arm].stroke, stall) for arm in controller.robot.objects.by_arm}

    def tell_again(self) -> None:
        """The controller was reset: tell it at once of what grippers held before."""
        for arm, grip in self._grips.items():
            if grip.holds:
                self._controller.set_holding(arm, True)

    def update(self, wanted: Mapping[str, float], measured: Mapping[str, float], now: float) -> bool:
        """Look at openings, 0 closed .. 1 open, at ``now`` [s], before the controller's step; whether one changed."""
        changed = False
        for arm, grip in self._grips.items():
            if arm in wanted:
                holds = grip.look(wanted[arm], measured.get(arm), now)
                if holds != self._controller.holding[arm]:
                    self._controller.set_holding(arm, holds)
                    changed = True
        return changed


class Grip:
    """The observations of one gripper."""

    def __init__(self, stroke: float, stall: float = STALL) -> None:
        self._stroke, self._stall = stroke, stall
        self.holds = False
        self._seen, self._since = math.nan, -math.inf  # opening, and since when it has been about that [s]

    def look(self, wanted: float, measured: float | None, now: float) -> bool:
        """Whether it holds something, after another ``measured`` opening; None: it has no measurement."""
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
