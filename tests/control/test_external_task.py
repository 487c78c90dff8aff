"""A task that another package brings, added by following docs/architecture.md."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from q2r2_control import CartesianController, ControllerSettings
from q2r2_control.errors import ConfigError
from tests.control.cells import cell
from tests.support.driven import Driven

TASK = """
import numpy as np

class ElbowTask:
    def __init__(self, robot, joint, angle, weight=0.1):
        self.index, self.angle, self.weight, self.nv = robot.joint_names.index(joint), angle, weight, robot.model.nv

    def cost(self, q, v):
        H, g = np.zeros((self.nv, self.nv)), np.zeros(self.nv)
        H[self.index, self.index] = self.weight
        g[self.index] = -self.weight * 2.0 * (self.angle - q[self.index])
        return H, g

class BrokenTask:
    def __init__(self, robot):
        self.nv = robot.model.nv

    def cost(self, q, v):
        return np.full((self.nv, self.nv), np.nan), np.zeros(self.nv)
"""
ENTRIES = "[q2r2_control.tasks]\nelbow = elbow_package:ElbowTask\nbroken = elbow_package:BrokenTask\n"


@pytest.fixture(autouse=True)
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An installed package with two tasks."""
    (tmp_path / "elbow_package.py").write_text(TASK)
    information = tmp_path / "elbow_package-1.0.dist-info"
    information.mkdir()
    (information / "METADATA").write_text("Metadata-Version: 2.1\nName: elbow-package\nVersion: 1.0\n")
    (information / "entry_points.txt").write_text(ENTRIES)
    monkeypatch.syspath_prepend(tmp_path)


def run(settings: ControllerSettings) -> float:
    """Final angle of the left arm's third joint while both tools keep their pose; the contract holds at every tick."""
    robot = cell("dual_iiwa7").robot
    controller = CartesianController(robot, settings)
    reference = Driven(controller).drive(2.0, lambda _, start: start)
    assert np.abs(reference.a).max() < 0.1
    return float(reference.q[2] - robot.home[2])


def test_a_task_of_another_package_moves_the_arm_within_every_promise() -> None:
    settings = {"joint": "left_A3", "angle": float(cell("dual_iiwa7").robot.home[2]) + 0.3}
    assert run(ControllerSettings(tasks={"elbow": settings})) > 0.1


def test_a_cost_that_is_no_number_is_not_used() -> None:
    assert run(ControllerSettings(tasks={"broken": {}})) == pytest.approx(run(ControllerSettings()), abs=1e-9)


@pytest.mark.parametrize(
    ("tasks", "message"),
    [
        ({"wrist": {}}, "control.tasks.wrist: installed tasks: .*broken, elbow"),
        ({"elbow": {"gain": 1.0}}, "control.tasks.elbow: .*unexpected keyword argument 'gain'"),
    ],
)
def test_an_unknown_task_and_a_bad_setting_are_refused_by_name(tasks: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        CartesianController(cell("dual_iiwa7").robot, ControllerSettings(tasks=tasks))
