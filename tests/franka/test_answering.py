"""The process that answers the robots says what is wrong, and brakes all arms if a robot refuses a command."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from q2r2_franka import limits
from q2r2_franka.limits import JOINTS
from q2r2_franka.settings import FrankaSettings
from q2r2_franka.state import Measured, Mode

from q2r2_control import CommandMode, PlantError

pytest.importorskip("pylibfranka", reason="pip install -e plugins/q2r2_franka")

from q2r2_franka import answering

BOTH = {"left": {"address": "127.0.0.2"}, "right": {"address": "127.0.0.3"}}
TORQUES = {"left": limits.TORQUE, "right": limits.TORQUE}


def test_the_error_for_a_record_that_cannot_be_written_names_the_setting_and_the_file(tmp_path: Path) -> None:
    file = tmp_path / "none" / "commands.bin"
    settings = FrankaSettings.model_validate(BOTH | {"record": str(file)})
    with pytest.raises(PlantError) as raised:
        answering.RobotAnswers(settings, CommandMode.POSITION, TORQUES)
    told = f"plant_settings.franka.record = {file}: No such file or directory; allowed: a file in a folder that exists"
    assert str(raised.value) == f"the robots are answered no more: {told}"


class Refusing:
    """The connection to a robot. Its library refuses all commands, as the real one refuses NaN."""

    is_open, file = True, -1

    def __init__(self, *_: Any) -> None:
        self.has_motion = True

    def read(self) -> Measured:
        none = (0.0,) * JOINTS
        held = tuple(0.5 * (limits.LOWER + limits.UPPER))
        return Measured(Mode.MOVE, "", 1, held, none, none, none, held, none)

    def write(self, values: list[float], finished: bool = False) -> None:
        raise ValueError("Commanding value is infinite or NaN.")

    def drop_motion(self) -> None:
        self.has_motion = False


def test_all_arms_brake_if_the_library_refuses_the_command_of_one_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(answering, "ArmLink", Refusing)
    settings = FrankaSettings.model_validate(BOTH)
    loop, process = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with loop, process:
        answers = answering._Answering(process, process, settings, CommandMode.POSITION, TORQUES, None)
        for session in answers._sessions.values():
            session.begin(np.array(Refusing().read().held), 0.0)
            session.state.following = True
        answers._answer("left")
    left, right = (answers._sessions[arm] for arm in ("left", "right"))
    assert not left.state.controlled
    assert left.state.problem == "Commanding value is infinite or NaN."
    assert not answers._links["left"].has_motion  # type: ignore[attr-defined]
    assert right.state.controlled
    assert not right.state.following
