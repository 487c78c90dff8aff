"""Moving obstacles on the page: at their reported poses, in a colour that shows whether their reports have ended."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("viser")

import viser

from q2r2_control.config.moving_obstacle import MovingObstacle, ObstacleReport
from q2r2_control.summary.tick import Tick
from q2r2_control.viewer.state_colours import AMBER, RED, obstacle_colour
from q2r2_control.viewer.web.figure import ObstacleFigure
from tests.pipeline.loops import pipeline
from tests.support.processes import cell

AT = (0.6, 1.4, 0.4)  # Position of the obstacles [m].


@pytest.fixture
def server() -> Iterator[viser.ViserServer]:
    made = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield made
    made.stop()


def test_each_tick_of_a_run_has_the_reported_obstacles_with_the_age_of_their_reports() -> None:
    loop = pipeline(control=cell().control.model_copy(update={"moving_obstacles": ("hand", "box")}))
    known = MovingObstacle(shape="sphere", size=(0.1,), position=AT, speed=0.1, age=0.05)
    moments = {0.1: ("hand", known), 0.2: ("box", known.model_copy(update={"speed": 0.0})), 0.5: ("hand", None)}
    ticks: list[Tick] = []

    def report(tick: Tick) -> None:
        ticks.append(tick)
        for moment in [moment for moment in moments if tick.t >= moment]:
            loop.move_obstacle(*moments.pop(moment))

    loop.listeners.append(report)
    loop.run(0.7, realtime=False)
    for tick in ticks:
        if tick.following and min(abs(tick.t - moment) for moment in (0.1, 0.2, 0.5)) > 0.004:
            assert set(tick.obstacles) == {
                *(["hand"] if 0.1 < tick.t < 0.5 else []),
                *(["box"] if tick.t > 0.2 else []),
            }
            for name, begun in (("hand", 0.1), ("box", 0.2)):
                if name in tick.obstacles:
                    shown = tick.obstacles[name]
                    assert shown.obstacle.position == AT
                    assert shown.age == pytest.approx(0.05 + tick.t - begun, abs=0.005)
                    old = name == "hand" and tick.t > 0.15
                    if abs(tick.t - 0.15) > 0.01:
                        assert obstacle_colour(shown) == (RED if old else AMBER)


def test_the_page_redraws_an_obstacle_when_it_moves_or_changes_until_it_is_gone(
    server: viser.ViserServer,
) -> None:
    figure = ObstacleFigure(server.scene, "/obstacles")

    def drawn(obstacle: MovingObstacle | None, age: float = 0.0) -> viser.MeshHandle | None:
        figure.show({} if obstacle is None else {"hand": ObstacleReport(obstacle, age)})
        found = server.scene.get_handle_by_name("/obstacles/hand")
        assert found is None or isinstance(found, viser.MeshHandle)
        return found

    box = MovingObstacle(shape="box", size=(0.1, 0.2, 0.4), position=AT, rpy=(0.0, 0.0, np.pi / 2), speed=0.1)
    first = drawn(box)
    assert first is not None
    np.testing.assert_allclose(first.position, AT)
    np.testing.assert_allclose(first.wxyz, (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)))
    np.testing.assert_allclose(np.ptp(first.vertices, axis=0), box.size, rtol=1e-6)
    moved = drawn(box.model_copy(update={"position": (0.0, 1.0, 0.0)}))
    assert moved is first
    np.testing.assert_allclose(moved.position, (0.0, 1.0, 0.0))
    ball = drawn(MovingObstacle(shape="sphere", size=(0.3,), position=AT, speed=0.1), age=1.0)
    assert ball is not None
    np.testing.assert_allclose(np.ptp(ball.vertices, axis=0), 0.6, rtol=1e-2)
    assert tuple(ball.color) == RED
    assert drawn(None) is None
