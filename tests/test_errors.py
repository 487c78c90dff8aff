"""For a wrong argument, every public name raises an error of this package with a message of one line."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import (
    CartesianController,
    Command,
    CommandMode,
    ConfigError,
    ControllerSettings,
    HandSample,
    MovingObstacle,
    Pipeline,
    PolicyInput,
    Q2R2Error,
    RelativeMotion,
    Robot,
    SampledTargets,
    load_config,
)
from q2r2_control.config.cell import Config
from q2r2_control.errors import RobotError
from q2r2_control.plants.base import Plant, make_plant
from q2r2_control.types import QUEST_CONTROLS

CONFIG = load_config("config/dual_iiwa7.yaml")
WRONG: Any = None  # A type checker would not allow values of these types.
FIVE: Any = 5
NO_SETTINGS: Any = {}
A_CELL: Any = CONFIG
TEXT: Any = "long"
SETTINGS = tuple(ControllerSettings.model_fields)
ARMS = "arms: left, right"
NUMBERS = "expected 14 finite numbers"
POSE = "allowed: a pin.SE3 with a proper rotation"
NO_NUMBER = pin.SE3(np.eye(3), np.array([0.0, math.nan, 0.0]))


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
def test_a_cell_is_loaded_only_from_a_path(path: Any) -> None:
    assert one_line(ConfigError, lambda: load_config(path)).endswith(
        "allowed: the path of a file, as text or pathlib.Path"
    )


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: ControllerSettings(acceleration_limit=-1),
            "ControllerSettings: acceleration_limit = -1: allowed: more than 0",
        ),
        (lambda: ControllerSettings(**{"foo": 1}), "ControllerSettings: foo = 1: unknown key; allowed here: acceler"),
        (
            lambda: ControllerSettings(**{"pairs": [{"pair": ("a", "b"), "distance": 3}]}),
            "ControllerSettings: pairs.0.distance = 3: allowed: 0.2 or less",
        ),
        (lambda: Config(**{"name": "cell"}), "Config: arms: missing"),
        (
            lambda: Config(**{"name": "cell", "arms": {"left": {"home": [0.0], "tool": {"link": 5}}}}),
            "Config: arms.left.tool.link = 5: allowed: text",
        ),
        (lambda: Config(**{"name": "cell", "arms": {"left": {"home": [0.0]}}}), "arms.left.model: missing; give one"),
        (
            lambda: Config(**{"name": "a", "arms": CONFIG.arms, "control": {"priority": "up"}}),
            "control.priority = 'up': allowed here: equal, left, right",
        ),
        (lambda: setattr(CONFIG.control, "min_distance", 0.1), "ControllerSettings.min_distance = 0.1: settings do no"),
        (lambda: RelativeMotion(scale=-1), "RelativeMotion: position_scale = -1: allowed: more than 0"),
    ],
)
def test_an_error_about_settings_made_in_python_names_key_value_and_what_is_allowed(
    make: Callable[[], object], said: str
) -> None:
    assert one_line(ConfigError, make).startswith(said)


@pytest.mark.parametrize(
    "arms", [None, {}, "left_tool_frame", ["left_tool_frame"], {"left": None}, {5: "left_tool_frame"}]
)
def test_arms_of_a_urdf_that_are_not_a_mapping_of_names_are_refused(robot: Robot, arms: Any) -> None:
    said = one_line(RobotError, lambda: Robot.from_urdf(robot.urdf, arms))
    assert said.endswith("expected a mapping such as {'left': 'left_tool_frame'}")


@pytest.mark.parametrize("q", [None, "abc", 5, [0.0] * 3, [math.nan] * 14, [[0.0]] * 14, [object()]])
def test_joint_positions_of_a_wrong_type_or_shape_are_refused_by_every_function(
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


def test_a_list_of_numbers_is_accepted_as_joint_positions(robot: Robot) -> None:
    assert robot.tool_pose(robot.home.tolist(), "left") == robot.tool_pose(robot.home, "left")


@pytest.mark.parametrize("arm", [None, "foo", 5, []])
def test_the_error_about_an_arm_that_does_not_exist_names_the_arms_that_exist(
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


def test_arguments_of_a_wrong_type_are_refused_by_the_function_that_gets_them(
    robot: Robot, controller: CartesianController
) -> None:
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
def test_brake_with_an_invalid_time_changes_nothing(controller: CartesianController, dt: Any) -> None:
    controller.reset(controller.robot.home)
    controller.brake(dt)
    np.testing.assert_allclose(controller.step({}, 0.001).q, controller.robot.home, atol=1e-9)


@pytest.mark.parametrize("pose", [None, 5, np.eye(4), NO_NUMBER, pin.SE3(np.zeros((3, 3)), np.zeros(3))])
def test_relative_motion_accepts_only_finite_poses(pose: Any) -> None:
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


KINDS: tuple[Any, ...] = (
    *(None, "foo", 5, -1.0, math.nan, b"x", [], (1, 2), {}, {5: 3}, object(), int, np.zeros(3), np.array(["a"])),
    pin.SE3.Identity(),
)
A_BALL: dict[str, Any] = {"shape": "sphere", "size": (0.1,), "speed": 1.0}
BALL = MovingObstacle(**A_BALL)
COMMAND = Command(CommandMode.POSITION, np.zeros(14), np.zeros(14), np.zeros(14), {})
SAMPLE = HandSample("left", np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), 0.0)
TOOL = {"left": "left_tool_frame"}
RELATIVE = ("stance", "scale", "rotation_frame", "rotation_scale", "axes", "axis_scales")
PARTS = ("config", "robot", "input", "plant", "mode")
STAMPS = ("pose_stamp", "inputs", "inputs_stamp", "fault")
COMMANDED = ("mode", "q", "v", "grippers")
MEASURED = ("q", "v", "tau_external", "stamp")


class Device:
    """An input and a plant of a user's program, which may return invalid values."""

    def __init__(self, plant: Plant) -> None:
        self.controls, self.connected, self.modes = QUEST_CONTROLS, True, plant.modes
        self.reset, self.apply, self.advance = plant.reset, plant.apply, plant.advance
        self.gripper_openings = plant.gripper_openings
        self.start = self.close = lambda: None
        self.send_haptic = lambda feedback: None
        self.returned: dict[str, Any] = {}
        self.poll = lambda now: self.returned.get("samples", [])
        self.state = lambda: self.returned.get("state", plant.state())


class Program:
    """The objects of a user's program: one valid argument of each kind."""

    def __init__(self, robot: Robot, controller: CartesianController) -> None:
        self.robot, self.controller, self.policy = robot, controller, PolicyInput()
        self.plant = make_plant("kinematic", robot, CONFIG)
        self.state, self.device = self.plant.state(), Device(self.plant)
        self.pipeline, self.unused = self.pipeline_of(), self.pipeline_of()

    def run(self, **returned: Any) -> None:
        self.device.returned = returned
        self.pipeline.run(0.005, realtime=False)

    def pipeline_of(self, **parts: Any) -> Pipeline:
        right: dict[str, Any] = {"config": CONFIG, "robot": self.robot, "input": self.device, "plant": self.device}
        return Pipeline(**right | parts)


Call = Callable[[Program, Any], object]


def each(what: str, names: Iterable[str], call: Callable[[Program, str, Any], object]) -> dict[str, Call]:
    """Return one call for each keyword in ``names``. Its key consists of ``what`` and the keyword."""

    def of(name: str) -> Call:
        return lambda own, x: call(own, name, x)

    return {f"{what} {name}": of(name) for name in names}


CALLS: dict[str, Call] = {
    "load_config": lambda own, x: load_config(x),
    **each("ControllerSettings", SETTINGS, lambda own, by, x: ControllerSettings(**{by: x})),
    "ControllerSettings.model_validate": lambda own, x: ControllerSettings.model_validate(x),
    "ControllerSettings.model_validate_json": lambda own, x: ControllerSettings.model_validate_json(x),
    "ControllerSettings.changed": lambda own, x: CONFIG.control.changed(x),
    **each("MovingObstacle", A_BALL, lambda own, by, x: MovingObstacle(**A_BALL | {by: x})),
    "Robot.from_config": lambda own, x: Robot.from_config(x),
    "Robot.from_urdf": lambda own, x: Robot.from_urdf(x, TOOL),
    "Robot.from_urdf arms": lambda own, x: Robot.from_urdf(own.robot.urdf, x),
    "Robot.from_urdf srdf": lambda own, x: Robot.from_urdf(own.robot.urdf, TOOL, FIVE if x is None else x),
    "Robot.from_urdf home": lambda own, x: Robot.from_urdf(own.robot.urdf, TOOL, home={"left_A1": x}),
    "Robot.arm": lambda own, x: own.robot.arm(x),
    "Robot.tool_pose": lambda own, x: own.robot.tool_pose(own.robot.home, x),
    "Robot.distances": lambda own, x: own.robot.distances(x),
    "Robot.closest_points": lambda own, x: own.robot.closest_points(own.robot.home, x),
    "Robot.capped_acceleration": lambda own, x: own.robot.capped_acceleration(x),
    "CartesianController": lambda own, x: CartesianController(x),
    "CartesianController settings": lambda own, x: CartesianController(own.robot, FIVE if x is None else x),
    "CartesianController solver": lambda own, x: CartesianController(own.robot, solver=FIVE if x is None else x),
    "CartesianController.reset": lambda own, x: own.controller.reset(own.robot.home, FIVE if x is None else x),
    "CartesianController.step": lambda own, x: own.controller.step(x, 0.001),
    "CartesianController.hold_at": lambda own, x: own.controller.hold_at(FIVE if x is None else x),
    "CartesianController.withdraw": lambda own, x: own.controller.withdraw(x),
    "CartesianController.tool_pose": lambda own, x: own.controller.tool_pose(x),
    "CartesianController.set_holding": lambda own, x: own.controller.set_holding(x, True),
    "CartesianController.set_opening": lambda own, x: own.controller.set_opening("left", x, 1.0),
    "CartesianController.move_obstacle": lambda own, x: own.controller.move_obstacle(x, BALL),
    "SampledTargets": lambda own, x: SampledTargets(x, 90.0),
    "SampledTargets rate_hz": lambda own, x: SampledTargets(own.controller, x),
    "SampledTargets.set": lambda own, x: SampledTargets(own.controller, 90.0).set(x, pin.SE3.Identity(), 0.0),
    "SampledTargets.set pose": lambda own, x: SampledTargets(own.controller, 90.0).set("left", x, 0.0),
    "SampledTargets.set now": lambda own, x: SampledTargets(own.controller, 90.0).set("left", pin.SE3.Identity(), x),
    "SampledTargets.release": lambda own, x: SampledTargets(own.controller, 90.0).release(x),
    "SampledTargets.at": lambda own, x: SampledTargets(own.controller, 90.0).at(x),
    **each("RelativeMotion", RELATIVE, lambda own, by, x: RelativeMotion(**{by: x})),
    "RelativeMotion.of": lambda own, x: RelativeMotion.of(x),
    **each("Pipeline", PARTS, lambda own, by, x: own.pipeline_of(**{by: x})),
    "Pipeline.from_config": lambda own, x: Pipeline.from_config(x),
    "Pipeline.tick_until": lambda own, x: own.unused.tick_until(x),
    "Pipeline.change_control": lambda own, x: own.pipeline.change_control(x),
    "Pipeline.change_teleop": lambda own, x: own.pipeline.change_teleop(x),
    "Pipeline.move_obstacle": lambda own, x: own.pipeline.move_obstacle(x, BALL),
    "Pipeline.mark": lambda own, x: own.pipeline.mark(x),
    "Pipeline.record_outcome": lambda own, x: own.pipeline.record_outcome(x),
    "PolicyInput": lambda own, x: PolicyInput(FIVE if x is None else x),
    "PolicyInput space": lambda own, x: PolicyInput(space=FIVE if x is None else x),
    "PolicyInput rate": lambda own, x: PolicyInput(rate=FIVE * -1 if x is None else x),
    "PolicyInput operator": lambda own, x: PolicyInput(operator=FIVE if x is None else x),
    "PolicyInput.observe": lambda own, x: own.policy.observe(x),
    "CommandMode": lambda own, x: CommandMode(str(x)),
    "Plant.apply": lambda own, x: own.plant.apply(x),
    **each("Plant.apply", COMMANDED, lambda own, by, x: own.plant.apply(replace(COMMAND, **{by: x}))),
    "Plant.advance": lambda own, x: own.plant.advance(x),
    "Plant.reset": lambda own, x: own.plant.reset(FIVE if x is None else x),
    "Input.poll": lambda own, x: own.run(samples=x),
    "Input.poll of samples": lambda own, x: own.run(samples=[x]),
    **each("Input.poll", STAMPS, lambda own, by, x: own.run(samples=[replace(SAMPLE, **{by: x})])),
    "Plant.state": lambda own, x: own.run(state=x),
    **each("Plant.state", MEASURED, lambda own, by, x: own.run(state=replace(own.state, **{by: x}))),
}


@pytest.fixture(scope="module")
def program(robot: Robot, controller: CartesianController) -> Program:
    return Program(robot, controller)


@pytest.mark.parametrize("name", CALLS)
def test_an_argument_of_a_wrong_type_raises_an_error_of_this_package_with_one_line(program: Program, name: str) -> None:
    refused = []
    for value in KINDS:
        try:
            CALLS[name](program, value)
        except Q2R2Error as error:
            refused.append(str(error))
        except Exception as error:
            raise AssertionError(f"{value!r}: {type(error).__name__}: {error}") from error
    assert not any("\n" in said for said in refused)
    assert len(refused) > len(KINDS) / 2
