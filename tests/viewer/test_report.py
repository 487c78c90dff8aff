"""The report's picture."""

from __future__ import annotations

from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from q2r2_control.config.cell import Config, load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunStatistics, RunSummary
from q2r2_control.viewer.history import History
from q2r2_control.viewer.report import draw_report
from tests.viewer.test_history import tick_at


def one_armed(config: Config) -> Config:
    return config.model_copy(update={"arms": {"right": config.arms["right"]}})


@pytest.mark.parametrize(
    ("arms", "engaged", "ticks"),
    [
        pytest.param(2, True, 200, id="two arms in penetration at the end"),
        pytest.param(1, True, 200, id="one arm"),
        pytest.param(2, False, 1, id="one tick, never engaged"),
    ],
)
def test_any_run_makes_a_picture(tmp_path: Path, arms: int, engaged: bool, ticks: int) -> None:
    config = load_config("config/dual_iiwa7.yaml")
    robot = Robot.from_config(config if arms == 2 else one_armed(config))
    history = History(robot, robot.capped_acceleration(10.0))
    for index in range(ticks):
        history(tick_at(robot, 0.01 * index, acceleration=0.1 * index, engaged=engaged, distance=0.5 - 0.003 * index))
    file = tmp_path / "report.png"
    draw_report(history, summary_of_nothing(robot), "a [title] with $signs", file)
    picture = matplotlib.image.imread(file)
    assert picture.shape[0] > 1000
    assert np.ptp(picture[..., 0]) > 0.9


def summary_of_nothing(robot: Robot) -> RunSummary:
    return RunStatistics(robot, ControllerSettings()).summary(1.0)
