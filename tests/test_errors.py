"""Every public name answers a wrong argument with one line of the package's own family of errors."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import (
    CartesianController,
    ConfigError,
    ControllerSettings,
    Pipeline,
    Q2R2Error,
    RelativeMotion,
    Robot,
    load_config,
)
from q2r2_control.config.cell import Config
from q2r2_control.errors import RobotError

CONFIG = load_config("config/dual_iiwa7.yaml")
WRONG: Any = None  # kinds that a type checker would not let pass
FIVE: Any = 5
NO_SETTINGS: Any = {}
A_CELL: Any = CONFIG
TEXT: Any = "long"
ARMS = "arms: left, right"
NUMBERS = "expected 14 finite numbers"
POSE = "allowed: a pin.SE3 with a proper rotation"
NO_NUMBER = pin.SE3(np.eye(3), np.array([0.0, math.nan, 0.0]))


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(CONFIG)


@pytest.fixture(scope="module")
def controller(robot: Robot) -> CartesianController:
    return CartesianController(robot)


@pytest.fixture(scope="module")
def pipeline() -> Pipeline:
    return Pipeline.from_config(CONFIG, input="scripted", plant="kinematic")


def one_line(kind: type[Q2R2Error], call: Callable[[], object]) -> str:
    with pytest.raises(kind) as error:
        call()
    text = str(error.value)
    assert "\n" not in text
    return text


@pytest.mark.parametrize("path", [None, {}, [], 5, b"cell.yaml"])
def test_a_cell_is_loaded_from_a_path_only(path: Any) -> None:
    assert one_line(ConfigError, lambda: load_config(path)).endswith(
        "allowed: the path of a file, as text or pathlib.Path"
    )


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: ControllerSettings(acceleration_limit=-1),
            "ControllerSettings: acceleration_limit = -1: Input should",
        ),
        (lambda: ControllerSettings(**{"foo": 1}), "ControllerSettings: foo = 1: unknown key; allowed here: acceler"),
        (
            lambda: ControllerSettings(**{"pairs": [{"pair": ("a", "b"), "distance": 3}]}),
            "ControllerSettings: pairs.0.distance = 3: Input should be less than or equal to 0.2",
        ),
        (lambda: Config(**{"name": "cell"}), "Config: arms: missing"),
        (
            lambda: Config(**{"name": "cell", "arms": {"left": {"home": [0.0], "tool": {"link": 5}}}}),
            "Config: arms.left.tool.link = 5: Input should be a valid string",
        ),
        (lambda: Config(**{"name": "cell", "arms": {"left": {"home": [0.0]}}}), "arms.left.model: missing; give one"),
        (
            lambda: Config(**{"name": "a", "arms": CONFIG.arms, "control": {"priority": "up"}}),
            "control.priority = 'up': allowed here: equal, left, right",
        ),
        (lambda: setattr(CONFIG.control, "min_distance", 0.1), "ControllerSettings.min_distance = 0.1: settings do no"),
        (lambda: RelativeMotion(scale=-1), "RelativeMotion: position_scale = -1: Input should be greater than 0"),
    ],
)
def test_settings_made_in_python_name_key_value_and_what_is_allowed(make: Callable[[], object], said: str) -> None:
    assert one_line(ConfigError, make).startswith(said)


@pytest.mark.parametrize(
    "arms", [None, {}, "left_tool_frame", ["left_tool_frame"], {"left": None}, {5: "left_tool_frame"}]
)
def test_arms_of_a_urdf_are_a_mapping_of_names(robot: Robot, arms: Any) -> None:
    said = one_line(RobotError, lambda: Robot.from_urdf(robot.urdf, arms))
    assert said.endswith("expected a mapping such as {'left': 'left_tool_frame'}")


@pytest.mark.parametrize("q", [None, "abc", 5, [0.0] * 3, [math.nan] * 14, [[0.0]] * 14, [object()]])
def test_joints_of_a_wrong_kind_or_shape_are_refused_wherever_they_go(
    robot: Robot, controller: CartesianController, q: Any
) -> None:
    pair = (robot.distances(robot.home)[0].name_a, robot.distances(robot.home)[0].name_b)
    for call in (
        lambda: robot.tool_pose(q, "left"),
        lambda: robot.distances(q),
        lambda: robot.distance_values(q),
        lambda: robot.closest_points(q, pair),
        lambda: controller.reset(q),
        *([] if q is None else [lambda: controller.reset(robot.home, q), lambda: controller.hold_at(q)]),
    ):
        assert NUMBERS in one_line(RobotError, call)
    assert np.isfinite(controller.step({}, 0.001, q).q).all(), "a posture that is not usable is not used"


def test_lists_of_numbers_are_joints_too(robot: Robot) -> None:
    assert robot.tool_pose(robot.home.tolist(), "left") == robot.tool_pose(robot.home, "left")


@pytest.mark.parametrize("arm", [None, "foo", 5, []])
def test_an_arm_that_does_not_exist_is_named_with_those_that_do(
    robot: Robot, controller: CartesianController, arm: Any
) -> None:
    for call in (
        lambda: robot.tool_pose(robot.home, arm),
        lambda: controller.tool_pose(arm),
        lambda: controller.spare_distance(arm),
        lambda: controller.set_opening(arm, 0.0, 1.0),
    ):
        said = one_line(RobotError, call)
        assert f"no arm {arm!r}; {ARMS}" in said


def test_wrong_parts_are_refused_where_they_come_in(robot: Robot, controller: CartesianController) -> None:
    for kind, call, said in (
        (RobotError, lambda: Robot.from_urdf(WRONG, {"left": "x"}), "None: neither URDF text nor the path of a file"),
        (RobotError, lambda: Robot.from_urdf(robot.urdf, {"left": "left_tool_frame"}, FIVE), "5: neither SRDF"),
        (
            RobotError,
            lambda: Robot.from_urdf(robot.urdf, dict.fromkeys("ab", "left_tool_frame")),
            "of its own for each",
        ),
        (ConfigError, lambda: Robot.from_config(WRONG), "allowed: a Config"),
        (ConfigError, lambda: CartesianController(WRONG), "allowed: a Robot"),
        (ConfigError, lambda: CartesianController(robot, NO_SETTINGS), "allowed: ControllerSettings"),
        (ConfigError, lambda: CartesianController(robot, A_CELL), "a Config has as config.control"),
        (RobotError, lambda: controller.step(WRONG, 0.001), "such as {'left': pose}"),
        (RobotError, lambda: robot.capped_acceleration(WRONG), "allowed: a number above 0"),
        (ConfigError, lambda: Pipeline.from_config(WRONG), "allowed: a Config"),
        (ConfigError, lambda: Pipeline.from_config(CONFIG, input=FIVE), "allowed: the name of an input"),
        (ConfigError, lambda: Pipeline.from_config(CONFIG, plant=FIVE), "allowed: the name of a plant"),
    ):
        assert said in one_line(kind, call)
    assert "allowed: new values by name" in str(controller.change(WRONG))


def test_a_pipeline_refuses_a_wrong_duration_and_wrong_settings(pipeline: Pipeline) -> None:
    for duration in (TEXT, 0.0, -1.0, math.nan, math.inf):
        said = one_line(ConfigError, partial(pipeline.run, duration))
        assert "allowed: a positive number of seconds" in said
    assert "allowed: new values by name" in one_line(ConfigError, lambda: pipeline.change_control(WRONG))
    assert "allowed: TeleopSettings" in one_line(ConfigError, lambda: pipeline.change_teleop(WRONG))


@pytest.mark.parametrize("dt", [math.nan, math.inf, -1.0, 0.0, None, "a"])
def test_a_time_that_is_none_brakes_nothing(controller: CartesianController, dt: Any) -> None:
    controller.reset(controller.robot.home)
    controller.brake(dt)
    np.testing.assert_allclose(controller.step({}, 0.001).q, controller.robot.home, atol=1e-9)


@pytest.mark.parametrize("pose", [None, 5, np.eye(4), NO_NUMBER, pin.SE3(np.zeros((3, 3)), np.zeros(3))])
def test_relative_motion_takes_finite_poses_only(pose: Any) -> None:
    unanchored, motion, identity = RelativeMotion(), RelativeMotion(), pin.SE3.Identity()
    motion.anchor(identity, identity)
    allowed = "allowed: finite numbers" if pose is NO_NUMBER else POSE
    for where, call in (
        ("anchor: hand", lambda: unanchored.anchor(pose, identity)),
        ("anchor: tool", lambda: unanchored.anchor(identity, pose)),
        ("target: hand", lambda: motion.target(pose)),
        ("hand: tool", lambda: motion.hand(pose)),
    ):
        said = one_line(Q2R2Error, call)
        assert said.startswith(f"RelativeMotion.{where} = ")
        assert said.endswith(allowed)
