"""The task for the swivel angle of an elbow, alone and in the controller, and a task of another package."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot
from q2r2_control.control.controller import check_settings
from q2r2_control.control.tasks.elbow import ElbowSwivel
from q2r2_control.errors import ConfigError
from q2r2_control.types import Array
from tests.control.cells import cell, random_posture
from tests.support.driven import Driven
from tests.support.modules import blocks_of, install


def test_the_swivel_is_the_angle_between_the_vertical_plane_and_the_plane_of_the_elbow() -> None:
    robot, random = cell("dual_iiwa7").robot, np.random.default_rng(31)
    task, data = ElbowSwivel(robot, {"left": None}), robot.model.createData()
    for _ in range(50):
        q = random_posture(robot, random)
        pin.forwardKinematics(robot.model, data, q)
        shoulder, elbow, wrist = (data.oMi[int(j) + 1].translation for j in robot.arms["left"].joints[[1, 3, 5]])
        line = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
        up, out = np.cross(line, [0.0, 0.0, 1.0]), np.cross(line, elbow - shoulder)
        sine = line @ np.cross(up, out)
        assert task.angle("left", q) == pytest.approx(np.arctan2(sine, up @ out), abs=1e-9)


def test_the_cost_turns_the_elbow_towards_its_angle_and_does_not_move_the_tool() -> None:
    robot, random = cell("dual_iiwa7").robot, np.random.default_rng(32)
    for _ in range(20):
        q = random_posture(robot, random)
        task = ElbowSwivel(robot, {"right": 0.4})
        H, g = task.cost(q, q)
        tool = pin.computeFrameJacobian(robot.model, robot.model.createData(), q, robot.arms["right"].frame_id)
        assert np.abs(tool @ g).max() < 1e-3 * np.linalg.norm(g) + 1e-12
        step = -1e-6 * g
        if np.linalg.norm(g) > 1e-3:
            before, after = (abs(np.sin(0.5 * (0.4 - task.angle("right", at)))) for at in (q, q + step))
            assert after < before
        assert np.linalg.eigvalsh(H).min() > -1e-9


def test_the_cost_decreases_to_zero_near_postures_without_a_swivel_angle() -> None:
    robot, random, shares = cell("dual_iiwa7").robot, np.random.default_rng(33), []
    task, data, arm = ElbowSwivel(robot, {"left": 0.4}), robot.model.createData(), robot.arms["left"]
    for _ in range(300):
        q = random_posture(robot, random)
        pin.forwardKinematics(robot.model, data, q)
        shoulder, elbow, wrist = (data.oMi[int(j) + 1].translation for j in arm.joints[[1, 3, 5]])
        line = (wrist - shoulder) / np.linalg.norm(wrist - shoulder)
        radius, sine = np.linalg.norm(np.cross(line, elbow - shoulder)), np.linalg.norm(line[:2])
        share = min(float(radius) / 0.05, 1.0) * min(float(sine) / 0.2, 1.0)
        if share > 0.6:
            continue
        steps = 1e-6 * np.eye(len(q))
        turned = [task.angle("left", q + step) - task.angle("left", q - step) for step in steps]
        gradient = np.array([np.arctan2(np.sin(angle), np.cos(angle)) for angle in turned]) / 2e-6
        J = pin.computeFrameJacobian(robot.model, data, q, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)
        gradient -= J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), J @ gradient)
        H, _ = task.cost(q, q)
        np.testing.assert_allclose(H, share * 0.1 * np.outer(gradient, gradient), rtol=1e-3, atol=1e-5)
        shares.append(share)
    assert min(shares) < 0.4
    assert len(shares) > 5


def run(angles: dict[str, float | None], start: Array) -> tuple[ElbowSwivel, Array, float]:
    """Drive for 4 s with the start poses of the tools as targets, and check the contract at every tick.

    Return the task, the final posture (nv,) [rad], and how far a tool has moved at most [m].
    """
    robot = cell("dual_iiwa7").robot
    run = Driven(CartesianController(robot, ControllerSettings(tasks={"swivel": {"angles": angles}})), start, dt=0.004)
    run.drive(4.0, run.start)
    assert np.abs(run.a).max() < 0.1
    tools = {arm: run.controller.tool_pose(arm).translation for arm in robot.arms}
    way = max(float(np.linalg.norm(tools[arm] - run.start[arm].translation)) for arm in robot.arms)
    return ElbowSwivel(robot, angles), run.q, way


def test_elbows_turn_to_their_angles_and_the_tools_stay_where_they_are() -> None:
    task, q, way = run({"left": 0.4, "right": -0.3}, cell("dual_iiwa7").robot.home)
    assert task.angle("left", q) == pytest.approx(0.4, abs=0.02)
    assert task.angle("right", q) == pytest.approx(-0.3, abs=0.02)
    assert way < 2e-4


def test_a_stretched_arm_with_an_elbow_angle_keeps_the_contract_and_comes_to_rest() -> None:
    robot = cell("dual_iiwa7").robot
    _, q, _ = run({"left": 1.0}, np.where(np.isin(np.arange(14), robot.arms["left"].joints), 0.0, robot.home))
    assert np.isfinite(q).all()


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"angles": {"middle": 0.1}}, "no arm 'middle'; allowed: left, right"),
        ({"angles": {"left": 0.1}, "joints": ["A2", "B4", "A6"]}, "left has no joint 'B4'; allowed: A1, A2"),
        ({"angles": {}, "joints": ["A2", "B4", "A6"]}, "angles = {}: allowed: an angle or null by arm"),
        ({"angles": {"left": 17.0}}, "angles.left = 17.0: allowed: -6.28 .. 6.28 rad, or null"),
        ({"angles": {"left": 0.1}, "joints": ["A2", "A6", "A4"]}, "allowed: three of left from base to tip"),
        ({"angles": {"left": 0.1}, "gain": 0.0}, "gain = 0.0: allowed: a number above 0"),
        (
            {"angles": {"left": 0.1}, "elbow": "B4"},
            "swivel.elbow = 'B4': no such setting; its settings: angles, joints",
        ),
        ({"angles": {"left": 0.1}, "joints": 5}, "joints = 5: allowed: three, at shoulder, elbow and wrist"),
    ],
)
def test_the_error_about_a_meaningless_setting_of_the_task_swivel_names_the_setting(
    settings: dict[str, object], told: str
) -> None:
    with pytest.raises(ConfigError, match=told):
        CartesianController(cell("dual_iiwa7").robot, ControllerSettings(tasks={"swivel": settings}))


BROKEN = """
class BrokenTask:
    def __init__(self, robot):
        self.nv = robot.model.nv

    def cost(self, q, v):
        return np.full((self.nv, self.nv), np.nan), np.zeros(self.nv)
"""
ENTRIES = "[q2r2_control.tasks]\nelbow = elbow_package:KeepElbowsOut\nbroken = elbow_package:BrokenTask\n"


@pytest.fixture(autouse=True)
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a package with two tasks: the example of docs/extending.md, and a task whose cost is not finite."""
    install(tmp_path, "elbow_package", "\n".join([*blocks_of("docs/extending.md", "python"), BROKEN]), ENTRIES)
    monkeypatch.syspath_prepend(tmp_path)


def moved_by(settings: ControllerSettings) -> float:
    """Return how far the left arm's third joint has turned from home [rad].

    The targets are the start poses of the tools. The contract is checked at every tick.
    """
    robot = cell("dual_iiwa7").robot
    controller = CartesianController(robot, settings)
    reference = Driven(controller, dt=0.004).drive(2.0, lambda _, start: start)
    assert np.abs(reference.a).max() < 0.1
    return float(reference.q[2] - robot.home[2])


def test_a_task_of_another_package_moves_the_arm_and_no_tick_violates_the_contract_of_the_controller() -> None:
    settings = {"angle": float(cell("dual_iiwa7").robot.home[2]) + 0.3, "weight": 0.1}
    assert moved_by(ControllerSettings(tasks={"elbow": settings})) > 0.1


def test_a_cost_that_is_not_finite_is_not_used() -> None:
    assert moved_by(ControllerSettings(tasks={"broken": {}})) == pytest.approx(moved_by(ControllerSettings()), abs=1e-9)


@pytest.mark.parametrize("look", [CartesianController, check_settings])
@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        ({"wrist": {}}, "control.tasks.wrist: installed tasks: .*broken, elbow"),
        ({"elbow": {"gain": 1.0}}, "control.tasks.elbow.gain = 1.0: no such setting; its settings: angle"),
    ],
)
def test_the_error_about_an_unknown_task_or_a_bad_setting_names_it_and_says_what_is_allowed(
    look: Callable[[Robot, ControllerSettings], object], tasks: dict, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        look(cell("dual_iiwa7").robot, ControllerSettings(tasks=tasks))
