"""The messages of a run to the page of a headset. They have the types with which the page's scripts are checked."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

import numpy as np
import pytest
from pydantic import TypeAdapter

pytest.importorskip("trimesh")

from q2r2_control.device_words import DeviceWords
from q2r2_control.events import Event, Reason
from q2r2_control.inputs.webxr.shown import ShownScene, ShownState
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.viewer.arm_words import Told
from q2r2_control.viewer.headset_display import RunDisplay, ShownTick
from q2r2_control.viewer.loose_parts import places_of_parts
from q2r2_control.viewer.shown_robot import ShownRobot
from tests.support.processes import cell
from tests.viewer.conftest import tick_at

HANDS = {"left": "left", "right": "right"}


@pytest.fixture(scope="module")
def plant() -> Iterator[MujocoPlant]:
    config = cell()
    with closing(MujocoPlant.from_config(Robot.from_config(config), config)) as made:
        yield made


@pytest.fixture(scope="module")
def display(plant: MujocoPlant) -> RunDisplay:
    config = cell()
    robot = Robot.from_config(config)
    parts = places_of_parts(plant, config)
    return RunDisplay(ShownRobot.of(robot, config), robot.model, robot.collision_model, parts)


def test_the_scene_contains_the_parts_of_the_task_and_the_links_that_move_with_each_tool(display: RunDisplay) -> None:
    scene = TypeAdapter(ShownScene).validate_python(display.scene())
    assert scene["name"] == cell().name
    assert set(scene["parts"]) == set(cell().mujoco.objects)
    for joints in scene["hands"].values():
        assert len(joints) >= 3  # They include the arm's last joint and the finger joints.
    assert not set(scene["hands"]["left"]) & set(scene["hands"]["right"])


def test_a_state_has_the_poses_of_parts_the_tightest_pair_and_texts_with_controls_in_braces(
    display: RunDisplay, plant: MujocoPlant, robot: Robot
) -> None:
    display.scene()
    tick = tick_at(robot, 1.0, engaged=False)
    pressed = Told(Event(0.5, "left", "pausing", "paused", Reason.of(TeleopReason.PRESSED, control="lower button")))
    shown = ShownTick(tick, (), {"left": pressed}, HANDS, plant.observed_qpos, "")
    state = TypeAdapter(ShownState).validate_python(display.message(shown))
    for name, part in cell().mujoco.objects.items():
        assert np.allclose(state["parts"][name][:3], part.position, atol=0.01)
        assert np.linalg.norm(state["parts"][name][3:]) == pytest.approx(1.0, abs=1e-3)
    assert state["pair"] is not None
    ends = np.array(state["pair"]["ends"])
    assert np.linalg.norm(ends[0] - ends[1]) > 0.0
    # The page replaces these names by the words of the device.
    assert state["arms"]["left"]["why"] == "{lower}"
    assert "{lower} to engage" in state["arms"]["left"]["next"]


def test_without_a_simulated_plant_no_loose_parts_are_shown(robot: Robot) -> None:
    assert places_of_parts(object(), cell()) == {}
    assert DeviceWords().noun("lower button") == "lower button"
