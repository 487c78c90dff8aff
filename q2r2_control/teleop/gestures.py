"""What a hand does with its controls: taps, holds and double taps, told from the headset's alignment chord."""

from __future__ import annotations

import math
from typing import NamedTuple

from q2r2_control.config.bindings import BUTTONS, HELD, LASTING, Action, Gesture
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.teleop.held_controls import is_held
from q2r2_control.types import HandInputs

_STUCK_AFTER = 1.0  # that a control is held from the first reading on before somebody is told [s]


class Press(NamedTuple):
    """A gesture of one control."""

    control: str
    gesture: Gesture


class GestureRecognizer:
    """Turns the levels of buttons, triggers and stick into gestures, each reported once.

    The two buttons of a chord never go down in the same sample, so a tap of a button is delayed by ``chord_window`` [s]
    (or until release, if that is earlier): when the other button follows, it was a chord and neither tap is reported.
    Where a control is bound to a hold too, a tap is over at release, and a hold after ``hold_time``; where it is
    bound to a double tap, the first tap waits for the second for ``double_tap_window``. Only stopping must not wait:
    ``DOWN`` reports a control at once, and may only be used to stop motion, which a chord does as well.

    A button that goes down while the other one is held makes a chord at any time. After a chord both buttons have to be
    released before either counts again; a control that is held from the first reading on, likewise.
    """

    def __init__(self, settings: TeleopSettings) -> None:
        bindings = settings.bindings
        bound = {(binding.control, binding.gesture) for binding in bindings.bound()}
        lasting = {binding.control for binding in bindings.bound() if binding.action in LASTING}
        stops = {binding.control: binding.gesture for binding in bindings.bound() if binding.action is Action.STOP}
        self._controls = {
            control: _Control(
                settings,
                waits=settings.chord_window if control in BUTTONS else 0.0,
                has_hold=(control, Gesture.HOLD) in bound,
                has_double=(control, Gesture.DOUBLE) in bound,
                stops=stops.get(control),
            )
            for control in (*BUTTONS, *HELD)
            if control in BUTTONS or (control not in lasting and any(name == control for name, _ in bound))
        }
        self._buttons = [self._controls[control] for control in BUTTONS]
        self._open = False  # whether time alone may end a gesture; at most ticks it cannot
        self.forget()

    def cancel(self) -> None:
        """Drop gestures that are not over, but a stop; what is held has to be released before it counts again."""
        for control in self._controls.values():
            control.mute()

    def forget(self) -> None:
        """Drop everything, and treat all controls as held until they are seen released."""
        self.chord = False  # both buttons were pressed together, and not all released since
        self._stamp = self._first = -math.inf  # of the readings since then
        self._told_stuck = False
        for control in self._controls.values():
            control.forget()

    @property
    def settled(self) -> bool:
        """Whether nothing is going on, and nothing can begin before the next reading."""
        return not self._open and not self.chord and (self._told_stuck or self._first == -math.inf)

    def stale(self, now: float, timeout: float) -> bool:
        """Whether no inputs were received for ``timeout`` [s]: the operator could not stop the arm by a button."""
        return now - self._stamp > timeout

    def receive(self, inputs: HandInputs, stamp: float, now: float) -> list[Press]:
        """Process one reading received at ``stamp`` [s]; one that is older than the last is ignored."""
        stamp = min(stamp, now)
        if not self._stamp <= stamp or stamp == -math.inf:
            return []
        if self._first == -math.inf:
            self._first = stamp
        self._stamp = stamp
        self._open = True
        found, rose = [], False
        for name, control in self._controls.items():
            level = is_held(name, inputs, control.down)
            rises = level and not control.down
            rose |= rises and name in BUTTONS
            gesture = control.released(stamp) if control.down and not level else None
            control.down = level
            control.seen_up |= not level
            if gesture is not None:
                found.append(Press(name, gesture))
            # With the other button it is a chord, or the rest of one.
            if rises and not (name in BUTTONS and (self.chord or (inputs.button_upper and inputs.button_lower))):
                if (late := control.begin(stamp)) is not None:
                    found.append(Press(name, late))
                found.append(Press(name, Gesture.DOWN))
        both = all(button.down for button in self._buttons)
        if self.chord:
            self.chord = any(button.down for button in self._buttons)
        elif both and rose:
            self.chord = True
            for button in self._buttons:
                button.cancel()
            found = [press for press in found if press.control not in BUTTONS]
        return found

    def take_stuck(self, now: float) -> Reason | None:
        """The reason, returned once, if controls do nothing since they are held for long from the first reading on."""
        if self._told_stuck or self._first == -math.inf or now - self._first <= _STUCK_AFTER:
            return None
        stuck = [name for name, control in self._controls.items() if control.down and not control.seen_up]
        self._told_stuck = True
        return Reason.of(ReasonKind.CONTROLS_HELD, controls=stuck) if stuck else None

    def due(self, now: float) -> list[Press]:
        """Gestures that are over because time has passed."""
        if not self._open:
            return []
        self._open = any(control.open for control in self._controls.values())
        return [
            Press(name, gesture)
            for name, control in self._controls.items()
            if (gesture := control.due(now)) is not None
        ]


class _Control:
    """One control's level, and its gesture while that may still become another one."""

    def __init__(
        self, settings: TeleopSettings, waits: float, has_hold: bool, has_double: bool, stops: Gesture | None
    ) -> None:
        self._waits = waits  # for the other button [s]
        self._hold = settings.hold_time if has_hold else math.inf
        self._double = settings.double_tap_window if has_double else None
        self._stops = stops  # the gesture that does
        self.forget()

    def forget(self) -> None:
        self.down = True  # as held until seen released, so that only a press that was seen from its start counts
        self.seen_up = False
        self.cancel()

    def mute(self) -> None:
        """Of what has begun only a stop counts."""
        self._muted = True
        if self._stops is None:
            self.cancel()

    def cancel(self) -> None:
        self._muted = False
        self._began: float | None = None  # of a press that is not over [s]
        self._tapped: float | None = None  # when a tap that may become a double one was over [s]

    @property
    def open(self) -> bool:
        """Whether a press, or what may become a double tap, has begun and is not over."""
        return self._began is not None or self._tapped is not None

    def begin(self, stamp: float) -> Gesture | None:
        """A press begins; returns the tap before it, where that was not the first of two."""
        tap = self.due(stamp)
        self._began = stamp
        self._muted = self._muted and self._tapped is not None
        return tap

    def released(self, stamp: float) -> Gesture | None:
        """A press ends; returns the gesture that it was, if that is over."""
        return self._audible(self._end(stamp))

    def due(self, now: float) -> Gesture | None:
        """The gesture that is over at ``now`` [s] because time has passed, or None."""
        return self._audible(self._timed(now))

    def _audible(self, gesture: Gesture | None) -> Gesture | None:
        return None if self._muted and gesture is not self._stops else gesture

    def _end(self, stamp: float) -> Gesture | None:
        if self._began is None:
            return None
        if (gesture := self._timed(stamp)) is not None:
            return gesture
        self._began = None
        if self._double is None:
            return Gesture.TAP
        if self._tapped is not None:
            self._tapped = None
            return Gesture.DOUBLE
        self._tapped = stamp
        return None

    def _timed(self, now: float) -> Gesture | None:
        if self._began is None:
            if self._tapped is not None and self._double is not None and now - self._tapped >= self._double:
                self._tapped = None
                return Gesture.TAP
            return None
        held = now - self._began
        if held >= self._hold:
            self._began = self._tapped = None
            return Gesture.HOLD
        if self._hold < math.inf:
            return None
        # A tap, or the second one; or too long for the first of two.
        single = self._double is None or self._tapped is not None
        if held < (self._waits if single or self._double is None else self._double):
            return None
        self._began = None
        gesture = Gesture.TAP if self._tapped is None else Gesture.DOUBLE
        self._tapped = None
        return gesture
