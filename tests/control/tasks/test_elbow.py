"""The elbow's swivel: its angle and gradient alone, then the task in the controller."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings
from q2r2_control.control.tasks.elbow import ElbowSwivel
from q2r2_control.errors import ConfigError
from q2r2_control.types import Array
from q2r2_control.verification.contract import Contract
from tests.control.cells import cell, random_posture

DT = 0.002


def test_the_angle_is_that_between_the_planes_through_the_line_up_and_to_the_elbow() -> None:
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


def test_the_cost_pulls_along_the_angles_gradient_and_does_not_move_the_tool() -> None:
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


def run(angles: dict[str, float | None], start: Array) -> tuple[ElbowSwivel, Array, float]:
    """Final posture and motion of the tools [m], while both keep their pose; the contract holds at every tick."""
    robot = cell("dual_iiwa7").robot
    controller = CartesianController(robot, ControllerSettings(tasks={"swivel": {"angles": angles}}))
    controller.reset(start)
    contract = Contract(controller, start)
    goals = {arm: controller.tool_pose(arm) for arm in robot.arms}
    for _ in range(2000):
        reference = controller.step(goals, DT)
        contract.check(reference, DT)
    assert np.abs(reference.a).max() < 0.1
    way = max(float(np.linalg.norm(controller.tool_pose(arm).translation - goals[arm].translation)) for arm in goals)
    return ElbowSwivel(robot, angles), reference.q, way


def test_elbows_turn_to_their_angles_and_the_tools_stay() -> None:
    task, q, way = run({"left": 0.4, "right": -0.3}, cell("dual_iiwa7").robot.home)
    assert task.angle("left", q) == pytest.approx(0.4, abs=0.02)
    assert task.angle("right", q) == pytest.approx(-0.3, abs=0.02)
    assert way < 2e-4


def test_a_stretched_arm_has_no_elbow_to_turn_and_rests() -> None:
    robot = cell("dual_iiwa7").robot
    _, q, _ = run({"left": 1.0}, np.where(np.isin(np.arange(14), robot.arms["left"].joints), 0.0, robot.home))
    assert np.isfinite(q).all()


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"angles": {"middle": 0.1}}, "no arm 'middle'; allowed: left, right"),
        ({"angles": {"left": 0.1}, "joints": ["A2", "B4", "A6"]}, "left has no joint 'B4'; allowed: A1, A2"),
        ({"angles": {}, "gain": 0.0}, "a gain and a weight above 0"),
        ({"angle": 0.1}, "angle"),
    ],
)
def test_settings_that_mean_nothing_are_refused_by_name(settings: dict[str, object], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        CartesianController(cell("dual_iiwa7").robot, ControllerSettings(tasks={"swivel": settings}))
