"""Teleoperators of lerobot as hands: lerobot's own classes, which drive simulated servos or read a simulated gamepad.

Run by ``make test-lerobot``, in an environment of its own.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("lerobot", reason="make test-lerobot installs it")
pytest.importorskip("q2r2_devices", reason="make test-lerobot installs it")

from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot.teleoperators import TeleoperatorConfig, make_teleoperator_from_config
from lerobot.utils.import_utils import register_third_party_plugins

from q2r2_control import Config, HandSample, InputError, Pipeline, load_config
from q2r2_control.inputs import make_input
from tests.devices.leader_arm import place, write_urdf
from tests.devices.mice import FULL, Hid, Mouse, buttons, translation, until
from tests.devices.test_pedal import DOWN, KEY_B, UP, events
from tests.lerobot.servo_bus import ServoBus
from tests.lerobot.sticks import Sticks
from tests.lerobot.test_commands import CHANGES, write_cell

register_third_party_plugins()
LINE = "input_settings.lerobot.right: "


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Iterator[ServoBus]:
    """Return a bus. Feetech's driver waits until the bus has answered or dropped the request, instead of for 50 ms.

    Otherwise these tests would fail on a busy computer, whose threads answer late.
    """
    sdk = pytest.importorskip("scservo_sdk", reason="make test-lerobot installs it")
    made = ServoBus()
    monkeypatch.setattr(sdk.PortHandler, "isPacketTimeout", lambda port: made.has_dropped)
    yield made
    made.close()


class Foot:
    """A foot on a pedal, which is a named pipe in place of an event device."""

    def __init__(self, folder: Path) -> None:
        os.mkfifo(path := folder / "event-kbd")
        self.path = str(path)
        self._file = os.open(path, os.O_RDWR)

    def press(self) -> None:
        os.write(self._file, events((KEY_B, DOWN)))

    def release(self) -> None:
        os.write(self._file, events((KEY_B, UP)))

    def unplug(self) -> None:
        os.close(self._file)


def settings(folder: Path, bus: ServoBus, pedal: str | None, calibrated: bool = True) -> dict[str, Any]:
    if calibrated:
        bus.calibrate(folder, "mine")
    teleoperator = {"type": "so101_leader", "port": bus.port, "id": "mine", "calibration_dir": str(folder)}
    leader = {"urdf": str(write_urdf(folder)), "tool": "tool"}
    return {"pedal": pedal, "right": {"teleoperator": teleoperator, "leader": leader}}


def cell(given: dict[str, Any]) -> Config:
    config = load_config("config/dual_iiwa7.yaml")
    return config.model_copy(update={"input_settings": {"lerobot": given}, "plant": "kinematic"})


def polled(source: Any, fits: Callable[[HandSample], bool]) -> HandSample:
    """Poll until ``fits`` is True for a sample, and return it. There is no timeout, because the threads may be slow."""
    while True:
        for sample in source.poll(time.monotonic()):
            if fits(sample):
                return sample
        time.sleep(0.001)


def test_a_leader_arm_gives_the_pose_of_its_tool_its_gripper_and_the_pedal(tmp_path: Path, bus: ServoBus) -> None:
    foot = Foot(tmp_path)
    source = make_input("lerobot", cell(settings(tmp_path, bus, foot.path)))
    source.start()
    first = polled(source, lambda sample: True)
    np.testing.assert_allclose(first.position, place(), atol=1e-3)
    assert (first.inputs.press_index, first.inputs.press_middle) == (0.0, 0.0)
    bus.turn("shoulder_pan", 30.0)
    bus.turn("elbow_flex", -45.0)
    bus.open_gripper(0.25)
    foot.press()
    wanted = place(pan=np.radians(30.0), elbow=np.radians(-45.0))
    moved = polled(source, lambda sample: sample.inputs.press_middle == 1.0 and sample.inputs.press_index > 0.5)
    np.testing.assert_allclose(moved.inputs.press_index, 0.75, atol=1e-3)
    moved = polled(source, lambda sample: abs(sample.position[2] - wanted[2]) < 1e-3)
    np.testing.assert_allclose(moved.position, wanted, atol=1e-3)
    foot.release()
    polled(source, lambda sample: sample.inputs.press_middle == 0.0)
    foot.press()
    polled(source, lambda sample: sample.inputs.press_middle == 1.0)
    foot.unplug()
    until(lambda: not source.connected)
    polled(source, lambda sample: sample.inputs.press_middle == 0.0)
    source.close()


def test_servos_without_power_are_lost_until_they_answer_again(tmp_path: Path, bus: ServoBus) -> None:
    lines: list[str] = []
    source = make_input("lerobot", cell(settings(tmp_path, bus, Foot(tmp_path).path)), say=lines.append)
    source.start()
    polled(source, lambda sample: True)
    bus.answers = False
    until(lambda: not source.connected)
    source.poll(time.monotonic())
    assert source.poll(time.monotonic()) == []
    bus.answers = True
    until(lambda: source.connected)
    polled(source, lambda sample: True)
    source.close()
    assert lines[0] == f"{LINE}mine SOLeader is connected"
    assert lines[2].startswith(f"{LINE}lost, Failed to sync read 'Present_Position'")
    assert lines[3] == lines[0]


@pytest.mark.parametrize("pedal", [True, False], ids=["not calibrated", "no pedal"])
def test_a_leader_that_is_not_ready_ends_the_start_with_one_line(tmp_path: Path, bus: ServoBus, pedal: bool) -> None:
    source = make_input("lerobot", cell(settings(tmp_path, bus, Foot(tmp_path).path if pedal else None, not pedal)))
    told = (
        "mine SOLeader is not calibrated; allowed: lerobot-calibrate --teleop.type=so101_leader"
        if pedal
        else "so_leader has no switch that engages an arm; allowed: input_settings.lerobot.pedal, "
    )
    with pytest.raises(InputError, match=f"^{LINE}{told}") as raised:
        source.start()
    assert "\n" not in str(raised.value)


def test_an_unknown_teleoperator_is_refused_with_the_names_of_the_known_teleoperators(tmp_path: Path) -> None:
    source = make_input("lerobot", cell({"right": {"teleoperator": {"type": "so102_leader"}}}))
    with pytest.raises(
        InputError, match=rf"^{LINE}teleoperator.type = so102_leader: allowed: .*gamepad, .*so101_leader"
    ):
        source.start()


def test_the_sticks_of_a_gamepad_give_the_velocity_of_its_hand_and_its_own_button_engages_the_arm(
    tmp_path: Path,
) -> None:
    sticks = Sticks.sticks
    source = make_input("lerobot", cell({"right": {"teleoperator": {"type": "sticks"}, "speed": 0.5}}))
    source.start()
    first = polled(source, lambda sample: True)
    assert first.inputs.press_middle == 0.0
    np.testing.assert_array_equal(first.position, np.zeros(3))
    sticks.deltas, sticks.intervention_flag, sticks.close_gripper_command = (0.0, 1.0, 0.0), True, True
    moved = polled(source, lambda sample: sample.position[1] > 0.05 and sample.inputs.press_index == 1.0)
    assert moved.inputs.press_middle == 1.0
    np.testing.assert_array_equal(moved.position[[0, 2]], (0.0, 0.0))
    sticks.deltas, sticks.intervention_flag, sticks.close_gripper_command = (0.0, 0.0, 0.0), False, False
    stays = polled(source, lambda sample: sample.inputs.press_middle == 0.0)
    assert stays.inputs.press_index == 1.0
    source.close()


class Watched:
    """The newest tick of a pipeline that runs in a thread."""

    def __init__(self, pipeline: Pipeline) -> None:
        self.tick: Any = None
        pipeline.listeners.append(self._see)

    def _see(self, tick: Any) -> None:
        self.tick = tick

    @property
    def tool(self) -> Any:
        return self.tick.tools["right"].translation.copy()


def test_a_leader_drives_the_cell_of_lerobots_robot_only_while_the_pedal_is_held(tmp_path: Path, bus: ServoBus) -> None:
    foot = Foot(tmp_path)
    given = f"input_settings: {{lerobot: {settings(tmp_path, bus, foot.path)}}}"
    choice, file = RobotConfig.get_choice_class("q2r2_cell"), write_cell(tmp_path, {"input_settings: {}": given})
    robot = make_robot_from_config(choice(calibration_dir=tmp_path / "none", cell=str(file), plant="kinematic"))
    choice = TeleoperatorConfig.get_choice_class("q2r2_hands")
    hands = make_teleoperator_from_config(choice(calibration_dir=tmp_path / "none", input="lerobot"))
    watched, way = Watched(robot.pipeline), 0.0

    def turn(degrees: float) -> None:
        bus.turn("shoulder_pan", degrees)
        for _ in range(20):
            robot.send_action(hands.get_action())
            time.sleep(1.0 / 30.0)

    robot.connect()
    hands.connect()
    try:
        turn(0.0)
        while way < 0.02:  # The press is repeated, because a busy computer may have stopped the arms meanwhile.
            before = watched.tool
            turn(5.0)
            turn(0.0)
            np.testing.assert_allclose(watched.tool, before, atol=1e-3)
            foot.press()
            turn(0.0)
            turn(5.0)
            way = watched.tool[1] - before[1]
            foot.release()
            until(lambda: watched.tick.states["right"] != "engaged")
            turn(0.0)
    finally:
        hands.disconnect()
        robot.disconnect()


def test_a_spacemouse_drives_the_cell_of_lerobots_robot_after_a_press(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mouse, rate = Mouse("/dev/hidraw3"), 25.0
    monkeypatch.setitem(sys.modules, "hidraw", Hid(mouse))
    file = write_cell(tmp_path, CHANGES | {"input_settings: {}": "input_settings: {spacemouse: {right: {speed: 0.1}}}"})
    choice = RobotConfig.get_choice_class("q2r2_cell")
    robot = make_robot_from_config(
        choice(calibration_dir=tmp_path / "none", cell=str(file), plant="kinematic", simulated_time=True, rate=rate)
    )
    choice = TeleoperatorConfig.get_choice_class("q2r2_hands")
    hands = make_teleoperator_from_config(choice(calibration_dir=tmp_path / "none", input="spacemouse"))
    watched = Watched(robot.pipeline)

    def send(report: bytes, steps: int) -> None:
        for _ in range(steps):
            mouse.send(report)
            robot.send_action(hands.get_action())

    robot.connect()
    hands.connect()
    send(translation(back=-FULL), 10)
    before = watched.tool
    send(buttons(), 5)
    send(translation(), 5)
    np.testing.assert_allclose(watched.tool, before, atol=1e-4)
    send(buttons(left=True), 5)
    send(buttons(), 5)
    send(translation(back=-FULL), 50)
    send(translation(), 25)
    np.testing.assert_allclose(watched.tool - before, (50 / rate * 0.1, 0.0, 0.0), atol=0.005)
    hands.disconnect()
    robot.disconnect()
