"""Requests of a program to a run: each takes effect at the next tick."""

from __future__ import annotations

import time

import numpy as np
import pytest

from q2r2_control.config.bindings import Action, BindingSettings
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.drives.base import TorqueDrive
from q2r2_control.errors import ConfigError
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.robot.obstacle_bodies import distances_with
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.reasons import TeleopReason
from tests.pipeline.loops import FreezingLoop, pipeline, when_moving
from tests.support.processes import cell, changes


def test_a_pause_holds_both_arms_until_a_new_press() -> None:
    loop = pipeline()
    loop.listeners.append(when_moving(loop.pause))
    summary = loop.run(3.0, realtime=False)
    for arm in ("left", "right"):
        assert changes(list(summary.events), arm)[-1] == ("engaged", "lost", "pause_requested")
    assert summary.at_rest


@pytest.mark.slow
def test_a_press_of_a_program_engages_arms_whose_hands_send_data_and_pauses_no_arm() -> None:
    loop = pipeline()
    loop.listeners.append(when_moving(loop.pause))
    pressed: list[Tick] = []

    def press(tick: Tick) -> None:
        if tick.t > 2.5 + 0.3 * len(pressed) and len(pressed) < 2:
            pressed.append(tick)
            loop.engage()

    loop.listeners.append(press)
    summary = loop.run(3.5, realtime=False)
    for arm in ("left", "right"):
        moved = [change for change in changes(list(summary.events), arm) if change[0] != change[1]]
        assert [before for before, *_ in moved[-2:]] == ["engaged", "lost"]
        assert moved[-1][1] == "engaged"


def test_a_press_of_a_program_does_not_engage_arms_that_have_a_dead_mans_switch() -> None:
    bindings = BindingSettings(lower=Action.NONE, grip=Action.DEAD_MAN)
    loop = pipeline(teleop=TeleopSettings(bindings=bindings))
    loop.listeners.append(lambda tick: loop.engage())
    assert not any(event.destination == "engaged" for event in loop.run(1.0, realtime=False).events)


@pytest.mark.slow
def test_stiffnesses_change_gradually_and_only_in_torque_mode() -> None:
    loop = pipeline(plant="mujoco", mode="torque")
    seen: list[float] = []

    def look(tick: Tick) -> None:
        if len(seen) == 0:
            loop.change_control({"translational_stiffness": 500.0, "position_gain": 5.0})
        assert isinstance(loop.drive, TorqueDrive)
        seen.append(loop.drive.impedance.in_force("left")["translational_stiffness"])

    loop.listeners.append(look)
    loop.run(1.0, realtime=False)
    assert seen[-1] == 500.0
    assert np.abs(np.diff(seen)).max() < 10.0
    with pytest.raises(ConfigError, match="translational_stiffness"):
        loop.change_control({"translational_stiffness": -1.0})
    with pytest.raises(ConfigError, match="translational_stiffness"):
        pipeline().change_control({"translational_stiffness": 500.0})


def test_the_report_of_a_moving_obstacle_grows_older_between_two_runs_of_one_pipeline() -> None:
    loop = pipeline(control=cell().control.model_copy(update={"moving_obstacles": ("hand",)}))
    hand = MovingObstacle(shape="sphere", size=(0.1,), position=(9.0, 9.0, 9.0), speed=0.1)
    reported: list[float] = []

    def look(tick: Tick) -> None:
        if not reported:
            loop.controller.move_obstacle("hand", hand)
            reported.append(time.monotonic())

    loop.listeners.append(look)
    loop.run(0.02)
    time.sleep(0.2)
    loop.run(0.02)
    assert loop.controller.obstacle_reports["hand"].age >= 0.2


def run_with_a_hand() -> tuple[Pipeline, MovingObstacle]:
    """Return a pipeline that knows a moving obstacle by its name, and a report of this obstacle far from the arms."""
    loop = pipeline(control=cell().control.model_copy(update={"moving_obstacles": ("hand",)}))
    return loop, MovingObstacle(shape="sphere", size=(0.1,), position=(9.0, 9.0, 9.0), speed=0.1, age=0.5)


def test_the_report_of_a_moving_obstacle_grows_older_before_the_run_begins() -> None:
    loop, hand = run_with_a_hand()
    loop.move_obstacle("hand", hand)
    time.sleep(0.2)
    loop.run(0.02)
    assert loop.controller.obstacle_reports["hand"].age >= 0.7


def test_the_report_of_a_moving_obstacle_stays_and_grows_older_after_a_run_in_simulated_time() -> None:
    loop, hand = run_with_a_hand()
    loop.move_obstacle("hand", hand)
    loop.run(0.02, realtime=False)
    assert loop.controller.obstacle_reports["hand"].age == pytest.approx(0.5, abs=0.1)
    time.sleep(0.2)
    loop.run(0.02)
    assert loop.controller.obstacle_reports["hand"].age >= 0.7


def test_the_report_of_a_moving_obstacle_grows_older_by_the_delay_of_a_late_first_tick() -> None:
    made, hand = run_with_a_hand()
    loop = FreezingLoop(made.config, made.robot, made.input, made.plant)
    loop.begin()
    loop.controller.move_obstacle("hand", hand)
    loop.freeze(0.3)
    loop.tick()
    assert 0.8 <= loop.controller.obstacle_reports["hand"].age < 0.9


@pytest.mark.slow
def test_a_moving_obstacle_in_front_of_an_arm_brakes_the_arm_and_is_named_in_an_event() -> None:
    loop = pipeline(control=cell().control.model_copy(update={"moving_obstacles": ("hand",)}))
    ticks: list[Tick] = []

    def report(tick: Tick) -> None:
        ticks.append(tick)
        if tick.t > 2.0:
            place = tuple(loop.robot.tool_pose(loop.robot.home, "left").translation.tolist())
            hand = MovingObstacle(shape="sphere", size=(0.1,), position=place, speed=0.1)
            loop.move_obstacle("hand", hand)

    loop.listeners.append(report)
    summary = loop.run(3.0, realtime=False)
    assert max(np.abs(tick.reference.v).max() for tick in ticks if tick.t < 2.0) > 0.1
    named = [
        event for event in summary.events if event.kind is TeleopReason.OBSTACLE_IN_THE_WAY and event.arm == "left"
    ]
    assert 1 <= len(named) < 20
    assert "hand_0" in named[0].reason.detail["pair"]
    assert TeleopReason.OBSTACLE_REPORTED not in {event.kind for event in summary.events}
    assert min(tick.reference.report.margin for tick in ticks) < 0.0
    with pytest.raises(ConfigError, match="foot"):
        loop.move_obstacle("foot", None)


@pytest.mark.slow
def test_in_torque_mode_the_wall_repels_an_arm_from_a_new_box_until_the_box_is_removed() -> None:
    loop = pipeline(
        plant="mujoco", mode="torque", control=cell().control.model_copy(update={"moving_obstacles": ("box",)})
    )
    robot, box, offset = loop.robot, MovingObstacle(shape="box", size=(0.1, 0.1, 0.1), speed=0.0), 0.3
    while distances_with(robot, {"box": box})(robot.home).min() > 0.003:
        offset -= 0.001
        # The box is beside the hand.
        place = tuple(robot.tool_pose(robot.home, "left").act(np.array([offset, 0.0, -0.12])).tolist())
        box = box.model_copy(update={"position": place})
    moments: dict[float, MovingObstacle | None] = {0.1: box, 0.2: None}
    pressed: dict[float, bool] = {}

    def report(tick: Tick) -> None:
        assert tick.wall is not None
        pressed[tick.t] = any("box_0" in pair for pair in tick.wall.pressing)
        for moment in [moment for moment in moments if tick.t >= moment]:
            loop.move_obstacle("box", moments.pop(moment))

    loop.listeners.append(report)
    loop.run(0.3, realtime=False)
    assert {t for t, pressing in pressed.items() if pressing} == {t for t in pressed if 0.101 < t < 0.201}


@pytest.mark.slow
def test_a_mark_without_a_recording_is_refused() -> None:
    loop = pipeline()
    loop.listeners.append(when_moving(lambda: loop.mark(Action.RECORD_MARK)))
    kinds = [event.kind for event in loop.run(2.5, realtime=False).events if event.arm == "left"]
    assert kinds[-2:] == [TeleopReason.RECORDING_REQUESTED, TeleopReason.NO_RECORDING]
