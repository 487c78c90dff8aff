"""An input whose hands are dragged on a page: a drag moves the tool, and a page that fails stops the arm."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.inputs.web import WebInput, web_cell
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array
from tests.pipeline.loops import pipeline
from tests.support.processes import cell, changes

BEGIN, END = 0.2, 0.8  # Times at which the drag begins and ends [s].
WAY = np.array([0.03, 0.0, 0.05])  # Displacement by the drag [m].


class Page:
    """A page that drags the left tool, and sends its pose 50 times a second."""

    def __init__(self, silent_at: float = np.inf, gone_at: float = np.inf) -> None:
        self.now, self.next = 0.0, BEGIN
        self.input = WebInput(clock=lambda: self.now)
        self.silent_at, self.gone_at = silent_at, gone_at
        self.tools: list[Array] = []
        self.loop: Pipeline = pipeline(self.input, teleop=web_cell(cell()).teleop)
        self.loop.listeners.append(self)

    def __call__(self, tick: Tick) -> None:
        self.now = tick.now
        self.tools.append(tick.tools["left"].translation.copy())
        if tick.t >= self.gone_at:
            self.input.lose()
            self.gone_at = self.next = np.inf
        if not self.next <= tick.t < self.silent_at:
            return
        home = pin.SE3ToXYZQUAT(self.loop.robot.tool_pose(self.loop.robot.home, "left"))
        share = np.clip((tick.t - BEGIN) / 0.4, 0.0, 1.0)
        for drag in (False, True) if self.next == BEGIN else (tick.t < END,):
            self.input.receive("left", home[:3] + share * WAY, home[3:], {"drag": float(drag), "gripper": 0.0})
        self.next = self.next + 0.02 if tick.t < END else np.inf


def test_a_drag_moves_the_tool_by_the_same_distance_and_the_arm_pauses_when_the_drag_ends() -> None:
    page = Page()
    summary = page.loop.run(1.5, realtime=False)
    engaged, paused = changes(list(summary.events), "left")
    assert engaged == ("idle", "engaged", "dead_man_held")
    assert paused == ("engaged", "paused", "dead_man_released")
    assert changes(list(summary.events), "right") == []
    assert page.tools[-1] - page.tools[0] == pytest.approx(WAY, abs=4e-3)


@pytest.mark.parametrize(
    ("page", "reason"),
    [(Page(silent_at=0.4), "pose_silent"), (Page(gone_at=0.4), "connection_lost")],
    ids=["falls silent", "is gone"],
)
def test_the_arm_stops_if_the_page_that_drags_its_tool_falls_silent_or_loses_its_connection(
    page: Page, reason: str
) -> None:
    summary = page.loop.run(1.2, realtime=False)
    assert changes(list(summary.events), "left")[-1] == ("engaged", "lost", reason)
    assert page.tools[-1] == pytest.approx(page.tools[-100], abs=1e-6)
