"""Requests of a program to a run, from any thread. The next tick carries them out, and records them for a replay."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

from q2r2_control.compliance.impedance import ImpedanceController, check_springs
from q2r2_control.config.bindings import Action
from q2r2_control.config.cell import Config
from q2r2_control.config.control import LIVE_IMPEDANCE
from q2r2_control.config.moving_obstacle import MovingObstacle, check_obstacle
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.drives.base import Drive, TorqueDrive
from q2r2_control.errors import ConfigError, check_kind, shown
from q2r2_control.events import Reason
from q2r2_control.inputs.base import Input
from q2r2_control.teleop.reasons import TeleopReason


class ObstacleRequest(NamedTuple):
    """A report of a moving obstacle, which ages until a tick takes it."""

    name: str
    obstacle: MovingObstacle | None
    reported: float  # The time of the report, by time.monotonic() [s].

    def reason(self, waited: float) -> Reason:
        """Return the request as it is recorded, ``waited`` [s] after the report."""
        given = None if self.obstacle is None else self.obstacle.model_dump(mode="json")
        if given is not None:
            given["age"] += waited
        return Reason.of(TeleopReason.OBSTACLE_REPORTED, name=self.name, obstacle=given)


Request = Reason | TeleopSettings | ObstacleRequest


class RequestedRun:
    """The requests of a program to a run.

    A waiting request is the reason that will be recorded, or the data from which this reason will be made.
    """

    config: Config
    input: Input
    drive: Drive

    def __init__(self) -> None:
        self.requests: deque[Request] = deque()

    @property
    def impedance(self) -> ImpedanceController | None:
        """The impedance controller of the drive; None if the mode is not torque."""
        return self.drive.impedance if isinstance(self.drive, TorqueDrive) else None

    def go_home(self) -> None:
        """Bring both arms home, as an operator may ask for it. Any thread may call this method.

        Any press ends the motion home. Events report the result.
        """
        self.requests.append(Reason(TeleopReason.HOME_REQUESTED))

    def pause(self) -> None:
        """Let both arms hold until a new press. Any thread may call this method."""
        self.requests.append(Reason(TeleopReason.PAUSE_REQUESTED))

    def engage(self) -> None:
        """Engage both arms as presses of their hands would, under the same conditions. Any thread may call it."""
        self.requests.append(Reason(TeleopReason.ENGAGE_REQUESTED))

    def give_back(self) -> None:
        """Let the policy move the arms again, from the poses that they have now. Any thread may call this method."""
        self.requests.append(Reason(TeleopReason.POLICY_REQUESTED))

    def mark(self, action: Action) -> None:
        """Begin, end or mark an episode of the recording, as an operator may. Any thread may call this method.

        Raises :class:`ConfigError` for an unknown action.
        """
        if not isinstance(action, str) or action not in list(Action):
            raise ConfigError(f"action = {shown(action)}: allowed: {', '.join(Action)}")
        self.requests.append(Reason.of(TeleopReason.RECORDING_REQUESTED, action=str(action)))

    def change_teleop(self, settings: TeleopSettings) -> None:
        """Change settings of the teleoperation for the rest of this run, without a jump. Any thread may call it.

        :meth:`Teleop.change` says when a change takes effect, and an event tells whether it did. Raises
        :class:`ConfigError` if a binding names a control that the input lacks.
        """
        check_kind("teleop", settings, TeleopSettings, "TeleopSettings, which a Config has as config.teleop")
        settings.bindings.check_device(self.input.controls)
        self.requests.append(settings)

    def change_control(self, values: Mapping[str, float]) -> None:
        """Change settings of the controller by name for the rest of this run, without a jump. Any thread may call it.

        In torque mode, settings in ``LIVE_IMPEDANCE`` may change too. :meth:`CartesianController.change` and
        :meth:`ImpedanceController.change` say how a change takes effect, and an event tells whether it did. Raises
        :class:`ConfigError` if a name or a value is never allowed.
        """
        check_kind("control", values, Mapping, "new values by name")
        springs = {} if self.impedance is None else {k: v for k, v in values.items() if k in LIVE_IMPEDANCE}
        check_springs(springs)
        self.config.control.changed({name: value for name, value in values.items() if name not in springs})
        self.requests.append(Reason.of(TeleopReason.CONTROL_REQUESTED, changes=dict(values)))

    def move_obstacle(self, name: str, obstacle: MovingObstacle | None) -> None:
        """Report where a moving obstacle is now, or that it is gone. Any thread may call it.

        :meth:`CartesianController.move_obstacle` says what follows, and an event names the pair that this method
        returns. In real time, the report ages from now on, also before the run begins. Raises :class:`ConfigError` if
        ``control.moving_obstacles`` lacks the name.
        """
        check_obstacle(name, obstacle, self.config.control.moving_obstacles)
        self.requests.append(ObstacleRequest(name, obstacle, time.monotonic()))

    def record_outcome(self, reason: Reason) -> None:
        """Report the outcome of the recording, or of an episode in it, to the operator. Any thread may call it."""
        check_kind("reason", reason, Reason, "a Reason")
        self.requests.append(reason)


def change_of(old: TeleopSettings, new: TeleopSettings) -> Reason:
    """Return the request that changes the settings ``old`` into the settings ``new``: the values that differ."""
    changes = _difference(old.model_dump(mode="json"), new.model_dump(mode="json"))
    return Reason.of(TeleopReason.SETTINGS_REQUESTED, changes=changes)


def changed(settings: TeleopSettings, changes: Mapping[str, Any]) -> TeleopSettings:
    """Return ``settings`` with the ``changes`` of a request. Raises :class:`ConfigError` if a change is invalid."""
    return TeleopSettings.model_validate(_merged(settings.model_dump(mode="json"), changes))


def _difference(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, value in new.items():
        before = old.get(name)
        if value == before:
            continue
        same = isinstance(value, dict) and isinstance(before, dict) and value.keys() == before.keys()
        found[name] = _difference(before, value) if same and isinstance(before, dict) else value
    return found


def _merged(old: Mapping[str, Any], changed: Mapping[str, Any]) -> dict[str, Any]:
    inner = {
        name: _merged(old[name], value)
        if isinstance(value, dict) and isinstance(old.get(name), dict) and value.keys() <= old[name].keys()
        else value
        for name, value in changed.items()
    }
    return {**old, **inner}
