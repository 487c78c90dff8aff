"""Hand motions of assembly work, and works in sequence."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot, load_config
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.assembly import HOME, WORKS, WayPoints, minimum_jerk
from q2r2_control.inputs.scripted import TRAJECTORIES, trajectory_named
from q2r2_control.types import SIDES


def test_way_points_begin_where_the_shipped_cell_has_its_tools() -> None:
    robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
    for arm, home in HOME.items():
        np.testing.assert_allclose(robot.tool_pose(robot.home, arm).translation, home, atol=1e-4)


@pytest.mark.parametrize("name", WORKS)
def test_every_work_has_rising_times_and_ends_at_home_with_open_grippers(name: str) -> None:
    work = WORKS[name]
    for hand, points in work.tools.items():
        times = [point[0] for point in points]
        assert times == sorted(set(times))
        assert times[0] > 0.0
        assert times[-1] <= work.duration
        assert points[-1][1:] == (*HOME[hand], 0.0, 0.0)
        assert len(work.presses[hand]) % 2 == 0


def test_works_in_sequence_do_what_each_of_them_does_one_after_the_other() -> None:
    both, first, second = (trajectory_named(name) for name in ("handover+stack", "handover", "stack"))
    assert first.duration is not None
    assert second.duration is not None
    assert both.duration is not None
    shift = WORKS["handover"].duration
    assert both.duration == pytest.approx(second.duration + shift)
    for hand in SIDES:
        for t in np.linspace(0.0, shift, 40):
            np.testing.assert_allclose(both.displacement(hand, t, 1.0), first.displacement(hand, t, 1.0), atol=1e-12)
        for t in np.linspace(2.0, second.duration, 40):
            expected = second.displacement(hand, t, 1.0)
            np.testing.assert_allclose(both.displacement(hand, t + shift, 1.0), expected, atol=1e-9)
        presses = first.upper_presses[hand] + tuple(t + shift for t in second.upper_presses[hand])
        assert both.upper_presses[hand] == pytest.approx(presses)


@pytest.mark.parametrize("name", ["handover+", "circle+stack", "spiral", ""])
def test_a_name_that_is_no_sequence_of_works_is_refused_with_those_that_are_allowed(name: str) -> None:
    with pytest.raises(
        ConfigError, match=r"allowed are circle, .*stack, and meet, grasp, handover, stack joined by \+"
    ):
        trajectory_named(name)
    assert set(WORKS) < set(TRAJECTORIES)


WAY = WayPoints([(1.0, 0.0, 0.0, 0.0, 0.0, 0.0), (2.0, 0.1, 0.0, 0.2, 0.0, 0.0), (4.0, 0.1, -0.3, 0.2, 0.4, 1.2)])


@pytest.mark.parametrize(
    ("t", "place", "turn"),
    [
        pytest.param(0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), id="it waits at the first"),
        pytest.param(1.5, (0.05, 0.0, 0.1), (0.0, 0.0, 0.0), id="it is half-way at half the time"),
        pytest.param(2.0, (0.1, 0.0, 0.2), (0.0, 0.0, 0.0), id="it is at each in time"),
        pytest.param(9.0, (0.1, -0.3, 0.2), (0.4, 0.0, 1.2), id="it stays at the last"),
    ],
)
def test_the_hand_is_where_its_way_points_say(
    t: float, place: tuple[float, ...], turn: tuple[float, float, float]
) -> None:
    where, rotation = WAY.at(t)
    np.testing.assert_allclose(where, place, atol=1e-12)
    tilted = pin.rpy.rpyToMatrix(turn[0], 0.0, 0.0) @ pin.rpy.rpyToMatrix(0.0, 0.0, turn[2])
    np.testing.assert_allclose(pin.exp3(rotation), tilted, atol=1e-12)


@pytest.mark.parametrize("t", [1.0, 2.0, 4.0])
def test_it_rests_at_every_way_point(t: float) -> None:
    before, after = WAY.at(t - 1e-4)[0], WAY.at(t + 1e-4)[0]
    assert np.linalg.norm(after - before) / 2e-4 < 1e-5


def test_minimum_jerk_is_cut_to_its_ends() -> None:
    assert [minimum_jerk(fraction) for fraction in (-1.0, 0.0, 0.5, 1.0, 2.0)] == [0.0, 0.0, 0.5, 1.0, 1.0]
