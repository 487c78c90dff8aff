"""A hand's controls: taps and holds, told from the headset's alignment chord, and actions that are held."""

from __future__ import annotations

import math
from typing import NamedTuple

from q2r2_control.config.bindings import BUTTONS, DEVICE_NAMES, LASTING, Action, BindingSettings, Gesture
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.types import HandInputs

_STUCK_AFTER = 1.0  # for so long a control is held from the first reading on before somebody is told [s]
# A control is held from the first of these on and let go below the second, so that noise in between changes nothing.
_HELD, _LET_GO = 0.6, 0.4


class Press(NamedTuple):
    """A gesture of one control."""

    control: str
    gesture: Gesture


def travel(control: str, inputs: HandInputs) -> float:
    """How far a control is pressed or pushed, 0 at rest and 1 at its end."""
    if control not in DEVICE_NAMES:
        return float(inputs.more.get(control, 0.0))
    name, way = DEVICE_NAMES[control]
    return way * float(getattr(inputs, name))


def _is_held(control: str, inputs: HandInputs, was_held: bool) -> bool:
    """Whether a control is far enough from rest; what is not a number is let go."""
    return travel(control, inputs) >= (_LET_GO if was_held else _HELD)


class HeldControls:
    """The actions of one hand that are held.

    A control counts as held only once it was seen let go, since the connection came up. A reading that is not a number
    lets go.
    """

    def __init__(self, bindings: BindingSettings) -> None:
        self._controls = [
            (binding.control, binding.action)
            for binding in bindings.bound()
            if binding.action in LASTING and binding.action is not Action.GRIPPER_ANALOG
        ]
        self.forget()

    def forget(self) -> None:
        """Nothing is held, and what is has to be let go before it counts."""
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
    """Turns the levels of buttons, triggers and stick into gestures, each reported once.

    The two buttons of a chord never go down in the same sample. A tap of a button is therefore delayed by
    ``chord_window`` [s] (or until release, if that is earlier). When the other button follows, it was a chord and
    neither tap is reported. Where a control is bound to a hold too, a tap is over at release, and a hold after
    ``hold_time``. Only stopping must not wait: ``DOWN`` reports a control at once, and may only be used to stop motion,
    which a chord does as well.

    A button that goes down while the other one is held makes a chord at any time. After a chord both buttons have to be
    released before either counts again; a control that is held from the first reading on, likewise.
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
        """Drop gestures that are not over, but a stop; what is held has to be released before it counts again."""
        for control in self._controls.values():
            control.mute()

    def forget(self) -> None:
        """Drop everything, and treat all controls as held until they are seen released."""
        self.chord = False  # both buttons were pressed together, and not all released since
        self._first = -math.inf  # of the readings since then [s]
        self._told_stuck = False
        for control in self._controls.values():
            control.forget()

    def receive(self, inputs: HandInputs, stamp: float) -> list[Press]:
        """Process a new reading, received at ``stamp`` [s]."""
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
            # With the other button it is a chord, or the rest of one.
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
        """The reason, returned once, if controls do nothing since they are held for long from the first reading on."""
        if self._told_stuck or self._first == -math.inf or now - self._first <= _STUCK_AFTER:
            return None
        stuck = [name for name, control in self._controls.items() if control.down and not control.seen_up]
        self._told_stuck = True
        return Reason.of(ReasonKind.CONTROLS_HELD, controls=stuck) if stuck else None

    def due(self, now: float) -> list[Press]:
        """Gestures that are over because time has passed."""
        begun = [(name, control) for name, control in self._controls.items() if control.began is not None]
        return [Press(name, gesture) for name, control in begun if (gesture := control.due(now)) is not None]


class _Control:
    """One control's level, and its press while that may still become another gesture."""

    def __init__(self, waits: float, hold: float, stops: Gesture | None) -> None:
        """``waits`` for the other button [s]; ``hold``: of a hold, inf: none [s]; ``stops``: the gesture that does."""
        self._waits, self._hold, self._stops = waits, hold, stops
        self.forget()

    def forget(self) -> None:
        self.down = True  # as held until seen released, so that only a press that was seen from its start counts
        self.seen_up = False
        self.cancel()

    def mute(self) -> None:
        self._muted = True
        if self._stops is None:
            self.cancel()

    def cancel(self) -> None:
        self._muted = False
        self.began: float | None = None  # of a press that is not over [s]

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
