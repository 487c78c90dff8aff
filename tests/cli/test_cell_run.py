"""The window of a run shows moving obstacles, and closing it ends the run."""

from __future__ import annotations

from collections.abc import Iterable

import pytest

from q2r2_control.cli.cell_run import show_window
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.viewer.state_colours import AMBER, RED
from tests.pipeline.loops import RecordingPlant
from tests.support.processes import cell

HAND = MovingObstacle(shape="sphere", size=(0.1,), position=(0.9, 0.0, 0.6), speed=0.25)


class PlantWithWindow(RecordingPlant):
    """A plant whose window is closed after some redraws."""

    def __init__(self, looks: int) -> None:
        super().__init__()
        self.looks = looks
        self.shown: list[list[tuple[MovingObstacle, tuple[int, int, int]]]] = []

    def launch_viewer(self) -> None:
        self.shown.clear()

    def viewer_sync(self, obstacles: Iterable[tuple[MovingObstacle, tuple[int, int, int]]] = ()) -> bool:
        self.shown.append(list(obstacles))
        return len(self.shown) < self.looks


@pytest.mark.slow
def test_the_window_shows_moving_obstacles_and_closing_it_ends_the_run() -> None:
    config = cell()
    control = config.control.model_copy(update={"moving_obstacles": ("hand",)})
    plant = PlantWithWindow(looks=5)
    pipeline = Pipeline.from_config(config.model_copy(update={"control": control}), plant=plant)
    show_window(pipeline)
    pipeline.move_obstacle("hand", HAND)
    summary = pipeline.run(1.0, realtime=False)
    assert [one for look in plant.shown for one, _ in look] == [HAND] * 5
    assert [plant.shown[look][0][1] for look in (0, -1)] == [AMBER, RED], "nothing has been reported since"
    assert summary.duration_s < 0.5
