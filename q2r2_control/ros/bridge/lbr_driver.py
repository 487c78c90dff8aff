"""The reports of the drivers of lbr_fri_ros2_stack: the state of each FRI session, and the external torques."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from enum import IntEnum
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from q2r2_control.events import Reason
from q2r2_control.plants.fri.reasons import FriReason
from q2r2_control.plants.fri.wire import CommandKind, Drives, Quality, Safety, Session, in_words
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import STREAM_QOS, BaseNode
from q2r2_control.types import Array, CommandMode

STATE_TOPICS = {"lbr_state": "for Jazzy", "state": "of 2024"}  # A driver's topics, and the releases that have them.
_SILENT = 0.5  # A driver without a message for this time has gone [s].
_RESTART = 1.0  # The restart of a driver's process takes longer than this [s].
_SAG = 0.01  # If measured joints are farther from commanded joints than this, something else moved the arm [rad].
_WANTED = {CommandMode.POSITION: CommandKind.POSITION, CommandMode.TORQUE: CommandKind.TORQUE}


class LbrDrivers:
    """Listens to the drivers of the arms. Arms follow commands only in COMMANDING_ACTIVE, as with :class:`FriPlant`.

    Commands overlay a motion of the cabinet, whose position (``ipo_joint_position``) stays where the session began. The
    first command of a session equals this position. After this command, the arm is held at the last command. An arm is
    not ready until its driver reports COMMANDING_ACTIVE, because joint states also come without a session.
    """

    def __init__(
        self,
        node: BaseNode,
        robot: Robot,
        namespaces: Mapping[str, str],
        mode: CommandMode,
        on_torques: Callable[[Array], None],
    ) -> None:
        """Listen to the drivers in ``namespaces``, by arm; ``on_torques`` gets the external torques (nv,) [Nm]."""
        self._node, self._robot, self._namespaces, self._mode = node, robot, dict(namespaces), mode
        self._on_torques, self._torques = on_torques, np.zeros(robot.model.nv)
        # The posture at which the arms are held (nv,) [rad]; NaN without a session, or if it is not known.
        self._held = np.full(robot.model.nv, np.nan)
        self._newest: dict[str, tuple[Any, float]] = {}  # By arm, the newest state and its receipt time [s].
        # Namespaces of drivers whose session has ended since commands began. They get no more commands, because the
        # first command of a new session has to equal the posture of the arm.
        self.withheld: set[str] = set()
        kind = import_module("lbr_fri_idl.msg").LBRState
        for arm, namespace in self._namespaces.items():
            for name in STATE_TOPICS:
                topic = f"{namespace}/{name}"
                node.create_subscription(kind, topic, partial(self._on_state, arm, topic), STREAM_QOS)

    def fault(self) -> Reason | None:
        """Return why an arm cannot be commanded, or None."""
        now = self._node.now
        for arm, namespace in self._namespaces.items():
            if arm not in self._newest:
                topics = " or ".join(f"{namespace}/{name}" for name in STATE_TOPICS)
                source = f"its driver on {topics}; to start it: {load_controller('lbr_state_broadcaster', namespace)}"
                return Reason.of(FriReason.FRI_SILENT, arm=arm, source=source)
            state, heard = self._newest[arm]
            if not -_SILENT <= now - heard <= _SILENT:
                return Reason.of(FriReason.FRI_SILENT, arm=arm, source=f"the driver in {namespace}")
            if (fault := session_fault(arm, state, self._mode)) is not None:
                return fault
        return None

    def held(self, q: Array) -> Array | None:
        """Return the posture (nv,) at which the arms are held, which the next command has to equal [rad].

        If the posture of an arm is not known, or not near the measured ``q`` (nv,) [rad], the result contains the
        measured positions of this arm. The result is None if the commands are torques.
        """
        if self._mode is not CommandMode.POSITION:
            return None
        held = q.copy()
        for arm in self._namespaces:
            joints = self._robot.arms[arm].joints
            if np.abs(self._held[joints] - q[joints]).max() < _SAG:
                held[joints] = self._held[joints]
        return held

    def begin(self) -> None:
        """Let the next command count as the first command after the controller was activated."""
        self.withheld.clear()
        for arm, (state, _) in self._newest.items():
            if state.session_state != Session.COMMANDING_ACTIVE:
                self.withheld.add(self._namespaces[arm])

    def commanded(self, q: Array) -> None:
        """Note that ``q`` (nv,) [rad] was sent."""
        for arm, namespace in self._namespaces.items():
            if namespace not in self.withheld:
                joints = self._robot.arms[arm].joints
                self._held[joints] = q[joints]

    def _on_state(self, arm: str, topic: str, state: Any) -> None:
        active, joints = state.session_state == Session.COMMANDING_ACTIVE, self._robot.arms[arm].joints
        ipo = state.ipo_joint_position
        if state.session_state not in list(Session) or (active and not np.isfinite(ipo).all()):
            self._node.drop(topic, f"session_state {state.session_state}, ipo_joint_position {ipo}")
            return
        now = self._node.now
        if arm not in self._newest:
            release = STATE_TOPICS[topic.rpartition("/")[2]]
            self._node.get_logger().info(f"{topic}: the driver of the {arm} arm, with the topics of releases {release}")
        elif now - self._newest[arm][1] > _RESTART:
            # The posture is forgotten, because the driver may have been restarted without a report.
            self._held[joints] = np.nan
        if not active:
            self._held[joints] = np.nan
            self.withheld.add(self._namespaces[arm])
        elif np.isnan(self._held[joints]).any():
            self._held[joints] = ipo
        self._newest[arm] = state, now
        torques = np.asarray(state.external_torque)
        if np.isfinite(torques).all():
            self._torques[joints] = torques
            if len(self._newest) == len(self._namespaces):
                self._on_torques(self._torques.copy())


def load_controller(name: str, namespace: str) -> str:
    """Return the command that starts a controller or broadcaster of the driver in this namespace."""
    return f"ros2 control load_controller --set-state active {name} -c {namespace}/controller_manager"


def session_fault(arm: str, state: Any, mode: CommandMode) -> Reason | None:
    """Return why an arm in this state does not follow commands of this mode, or None."""
    if state.session_state != Session.COMMANDING_ACTIVE:
        return Reason.of(
            FriReason.FRI_SESSION,
            arm=arm,
            session=_word(Session, state.session_state),
            quality=_word(Quality, state.connection_quality),
            safety=_word(Safety, state.safety_state),
            drives=_word(Drives, state.drive_state),
        )
    if state.client_command_mode != _WANTED[mode]:
        asked, wanted = _word(CommandKind, state.client_command_mode), _word(CommandKind, _WANTED[mode])
        return Reason.of(FriReason.FRI_COMMAND_MODE, arm=arm, asked=asked, wanted=wanted)
    return None


def _word(kind: type[IntEnum], value: int) -> str:
    """Return the name of a value, or its number if only a later version of FRI knows it."""
    return in_words(kind(value)) if value in list(kind) else str(value)
