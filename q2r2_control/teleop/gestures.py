"""Recognise taps, holds and the alignment chord, and find the actions that last while a control is held."""

from __future__ import annotations

import math
from typing import NamedTuple

from q2r2_control.config.bindings import BUTTONS, DEVICE_NAMES, LASTING, Action, BindingSettings, Gesture
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Reason
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import HandInputs

# If a control has been held since the first reading, the operator is told after this time [s].
_STUCK_AFTER = 1.0
# A control counts as held above the first travel, and as released below the second travel. Between the two travels,
# nothing changes.
_HELD, _LET_GO = 0.6, 0.4


class Press(NamedTuple):
    """One gesture of one control."""

    control: str
    gesture: Gesture


def travel(control: str, inputs: HandInputs) -> float:
    """Return how far a control is pressed or pushed, from 0 at rest to 1 at its end."""
    if control not in DEVICE_NAMES:
        return float(inputs.more.get(control, 0.0))
    name, sign = DEVICE_NAMES[control]
    return sign * float(getattr(inputs, name))


def _is_held(control: str, inputs: HandInputs, was_held: bool) -> bool:
    """Return whether a control is held. A reading of NaN counts as a released control."""
    return travel(control, inputs) >= (_LET_GO if was_held else _HELD)


class HeldControls:
    """The actions of one hand that last while their control is held.

    A control counts only after a reading of this connection has shown it released. A reading of NaN counts as released.
    """

    def __init__(self, bindings: BindingSettings) -> None:
        self._controls = [
            (binding.control, binding.action)
            for binding in bindings.bound()
            if binding.action in LASTING and binding.action is not Action.GRIPPER_ANALOG
        ]
        self.forget()

    def forget(self) -> None:
        """Count all controls as released. A control counts again only after a reading has shown it released."""
        self._seen_let_go: set[str] = set()
        self.actions: frozenset[Action] = frozenset()

    def receive(self, inputs: HandInputs) -> None:
        held = set()
        for control, action in self._controls:
            if not _is_held(control, inputs, action in self.actions):
                self._seen_let_go.add(control)
            elif control in self._seen_let_go:
                held.add(action)
        self.actions = frozenset(held)


class GestureRecognizer:
    """Turns the levels of buttons, triggers and stick into gestures. Each gesture is reported once.

    The two buttons of a chord hardly ever go down in the same sample. A tap of a button is therefore reported after
    ``chord_window`` [s], or at its release if the release is earlier. If the other button goes down before this, the
    press is a chord, and no tap is reported. If a control is bound to a hold as well, a tap is reported at its release,
    and a hold after ``hold_time`` [s]. A stop must not wait, so ``DOWN`` reports every press at once. ``DOWN`` may only
    be used to stop motion, because the press may still become a chord, which stops motion as well.

    A button that goes down while the other one is held makes a chord at any time. After a chord both buttons have to be
    released before either of them counts again. Likewise, a control that is held at the first reading counts only after
    its release.
    """

    def __init__(self, settings: TeleopSettings) -> None:
        bound = [binding for binding in settings.bindings.bound() if binding.action not in LASTING]
        holds = {binding.control for binding in bound if binding.gesture is Gesture.HOLD}
        stops = {binding.control: binding.gesture for binding in bound if binding.action is Action.STOP}
        self._controls = {
            control: _Control(
                waits=settings.chord_window if control in BUTTONS else 0.0,
                hold=settings.hold_time if control in holds else math.inf,
                stops=stops.get(control),
            )
            for control in dict.fromkeys((*BUTTONS, *(binding.control for binding in bound)))
        }
        self._buttons = [self._controls[control] for control in BUTTONS]
        self.forget()

    def cancel(self) -> None:
        """Drop unfinished gestures, except a gesture that stops the arms. Held controls count after their release."""
        for control in self._controls.values():
            control.mute()

    def forget(self) -> None:
        """Drop all gestures and readings. A control counts again only after a reading has shown it released."""
        self.chord = False  # Whether both buttons were pressed together, and one of them is still held.
        self._first = -math.inf  # Time of the first reading after this call [s].
        self._told_stuck = False
        for control in self._controls.values():
            control.forget()

    def receive(self, inputs: HandInputs, stamp: float) -> list[Press]:
        """Process a reading that was received at ``stamp`` [s]; returns the gestures that it completes."""
        if self._first == -math.inf:
            self._first = stamp
        found, rose = [], False
        for name, control in self._controls.items():
            level = _is_held(name, inputs, control.down)
            rises = level and not control.down
            rose |= rises and name in BUTTONS
            gesture = control.released(stamp) if control.down and not level else None
            control.down = level
            control.seen_up |= not level
            if gesture is not None:
                found.append(Press(name, gesture))
            # A button that goes down while the other one is down, or during a chord, is not reported as a press.
            if rises and not (name in BUTTONS and (self.chord or (inputs.button_upper and inputs.button_lower))):
                control.begin(stamp)
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
        """Return a reason, only once, if controls have no effect because they were held at every reading so far."""
        if self._told_stuck or self._first == -math.inf or now - self._first <= _STUCK_AFTER:
            return None
        stuck = [name for name, control in self._controls.items() if control.down and not control.seen_up]
        self._told_stuck = True
        return Reason.of(TeleopReason.CONTROLS_HELD, controls=stuck) if stuck else None

    def due(self, now: float) -> list[Press]:
        """Return the gestures that are complete because enough time has passed at ``now`` [s]."""
        begun = [(name, control) for name, control in self._controls.items() if control.began is not None]
        return [Press(name, gesture) for name, control in begun if (gesture := control.due(now)) is not None]


class _Control:
    """One control: whether it is held, and its present press while the kind of gesture is not decided yet."""

    def __init__(self, waits: float, hold: float, stops: Gesture | None) -> None:
        """Make a control that counts as held.

        Args:
            waits: Time for which a tap waits for the other button of a chord [s].
            hold: Duration of a hold; infinite if the control has no hold [s].
            stops: The gesture of this control that stops the arms, or None.
        """
        self._waits, self._hold, self._stops = waits, hold, stops
        self.forget()

    def forget(self) -> None:
        # The control counts as held until a reading shows it released. Only a press that was seen from its start
        # counts.
        self.down = True
        self.seen_up = False
        self.cancel()

    def mute(self) -> None:
        self._muted = True
        if self._stops is None:
            self.cancel()

    def cancel(self) -> None:
        self._muted = False
        self.began: float | None = None  # Time at which the undecided press began [s]; None if there is none.

    def begin(self, stamp: float) -> None:
        self.began, self._muted = stamp, False

    def released(self, stamp: float) -> Gesture | None:
        if self.began is None:
            return None
        return self._end(Gesture.HOLD if stamp - self.began >= self._hold else Gesture.TAP)

    def due(self, now: float) -> Gesture | None:
        if self.began is None:
            return None
        held = now - self.began
        if self._hold < math.inf:
            return self._end(Gesture.HOLD) if held >= self._hold else None
        return self._end(Gesture.TAP) if held >= self._waits else None

    def _end(self, gesture: Gesture) -> Gesture | None:
        self.began = None
        return None if self._muted and gesture is not self._stops else gesture
