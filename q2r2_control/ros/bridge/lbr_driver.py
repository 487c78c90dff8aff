"""The arms as lbr_fri_ros2_stack tells of them: the state of each FRI session, and the external torques."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from enum import IntEnum
from functools import partial
from importlib import import_module
from typing import Any

import numpy as np

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.plants.fri.wire import CommandKind, Drives, Quality, Safety, Session, in_words
from q2r2_control.robot.robot import Robot
from q2r2_control.ros.base_node import STREAM_QOS, BaseNode
from q2r2_control.types import Array, CommandMode

_NAMES = "lbr_state", "state"  # of the topic, in releases for Jazzy and in those of 2024
_SILENT = 0.5  # a driver that has been heard and says nothing for longer is gone [s]
_WANTED = {CommandMode.POSITION: CommandKind.POSITION, CommandMode.TORQUE: CommandKind.TORQUE}


class LbrDrivers:
    """Listens to the drivers of the arms. Commands count in commanding active only, as with :class:`FriPlant`."""

    def __init__(
        self,
        node: BaseNode,
        robot: Robot,
        namespaces: Mapping[str, str],
        mode: CommandMode,
        on_torques: Callable[[Array], None],
    ) -> None:
        """``namespaces`` of the drivers, by arm. ``on_torques`` gets external torques (nv,) [Nm] of all arms."""
        self._robot, self._namespaces, self._wanted = robot, dict(namespaces), _WANTED[mode]
        self._on_torques, self._torques = on_torques, np.zeros(robot.model.nv)
        self._held = np.full(robot.model.nv, np.nan)  # by the cabinets' own interpolation [rad]
        self._newest: dict[str, tuple[Any, float]] = {}  # of each arm, and when it came [s]
        kind = import_module("lbr_fri_idl.msg").LBRState
        for arm, namespace in self._namespaces.items():
            for name in _NAMES:
                node.create_subscription(kind, f"{namespace}/{name}", partial(self._on_state, arm), STREAM_QOS)

    def fault(self) -> Reason | None:
        """Why an arm cannot be commanded, or None; nothing is said of a driver that was never heard."""
        now = time.monotonic()
        for arm, (state, heard) in self._newest.items():
            if now - heard > _SILENT:
                return Reason.of(ReasonKind.FRI_SILENT, arm=arm, source=f"the driver in {self._namespaces[arm]}")
            if state.session_state != Session.COMMANDING_ACTIVE:
                return Reason.of(
                    ReasonKind.FRI_SESSION,
                    arm=arm,
                    session=_word(Session, state.session_state),
                    quality=_word(Quality, state.connection_quality),
                    safety=_word(Safety, state.safety_state),
                    drives=_word(Drives, state.drive_state),
                )
            if state.client_command_mode != self._wanted:
                asked, wanted = _word(CommandKind, state.client_command_mode), _word(CommandKind, self._wanted)
                return Reason.of(ReasonKind.FRI_COMMAND_MODE, arm=arm, asked=asked, wanted=wanted)
        return None

    def held(self) -> Array | None:
        """Where the cabinets hold the arms, (nv,) [rad], which the first command has to equal; None: not known."""
        return self._held.copy() if np.isfinite(self._held).all() else None

    def _on_state(self, arm: str, state: Any) -> None:
        self._newest[arm] = state, time.monotonic()
        self._held[self._robot.arms[arm].joints] = state.ipo_joint_position
        torques = np.asarray(state.external_torque)
        if np.isfinite(torques).all():
            self._torques[self._robot.arms[arm].joints] = torques
            if len(self._newest) == len(self._namespaces):
                self._on_torques(self._torques.copy())


def _word(kind: type[IntEnum], value: int) -> str:
    """In words; a number that a later version of FRI may have stays one."""
    return in_words(kind(value)) if value in list(kind) else str(value)
