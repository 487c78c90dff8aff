"""Operators align the frame, move their hands while an arm is paused, and engage again.

No arm moves unless its hand moves it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.teleop.hand_motion import MAX_OFFSET
from q2r2_control.types import SIDES, CommandMode
from tests.support.headset_in_step import InStepRun, Operator

pytestmark = pytest.mark.slow

# Displacement of the frame by an alignment, or of the hands during a pause.
ANEW = pin.SE3(pin.exp3(np.array([0.0, 0.0, math.radians(120.0)])), np.array([0.4, 0.0, 0.0]))
STILL = 5e-4  # A tool that moves by less than this counts as resting [m].
again_and_again = pytest.mark.parametrize("times", [10, pytest.param(100, marks=pytest.mark.soak)])


def aligned(op: Operator, shift: float, samples: int) -> Iterator[float]:
    """Align with the chord of the left hand. The frame moves ``samples`` samples after the buttons are pressed.

    The frame moves by the fraction ``shift`` of ``ANEW``.
    """
    op.lower.add("left")
    op.upper.add("left")
    yield samples * op.period
    op.frame = pin.SE3.Interpolate(pin.SE3.Identity(), ANEW, shift)
    yield 0.2
    op.lower.clear()
    op.upper.clear()
    yield 0.2


@pytest.mark.parametrize(
    ("engaged", "first", "shift", "samples"),
    [
        pytest.param(SIDES, "lower", 1.0, 0, id="far, with the second button"),
        pytest.param(SIDES, "upper", 0.1, 1, id="by less than the gates, in the next sample"),
        pytest.param(("right",), None, 1.0, 1, id="far, the other arm alone engaged, not linked"),
        pytest.param(SIDES, None, 0.1, 1, id="by less than the gates, both arms engaged, not linked"),
    ],
)
def test_an_alignment_by_one_hand_moves_no_arm_and_no_gripper(
    engaged: tuple[str, ...], first: str | None, shift: float, samples: int
) -> None:
    def script(op: Operator) -> Iterator[float]:
        yield 0.1
        yield from op.press(*engaged)
        yield 0.2
        if first is not None:  # One button is pressed 30 ms before the other.
            getattr(op, first).add("left")
            yield 0.03
        yield from aligned(op, shift, samples)

    run = InStepRun(script, linked=first is not None)
    assert run.reasons("lost") == []
    assert {tick.targets[arm].gripper for tick in run.ticks for arm in SIDES} == {1.0}
    for arm in SIDES:
        assert np.linalg.norm(run.tool(arm) - run.tool(arm)[0], axis=1).max() < STILL
    assert run.reasons("aligning") == ["alignment_chord"] * len(engaged)
    assert {arm for arm, state in run.ticks[-1].states.items() if state == "engaged"} == set(engaged)


@again_and_again
def test_an_arm_under_an_unknown_load_sinks_no_farther_when_it_is_paused_and_engaged_many_times(times: int) -> None:
    def script(op: Operator) -> Iterator[float]:
        op.noise = 1e-9
        yield from op.engage()
        op.plant.push("left", np.array([0.0, 0.0, -42.0, 0.0, 0.0, 0.0]), 100.0)
        yield 1.0
        yield from op.press(*SIDES)
        for hand, at in op.hands.items():
            op.hands[hand] = pin.SE3(ANEW.rotation @ at.rotation, at.translation + ANEW.translation)
        yield 2.0  # The arm comes to rest on the spring of its impedance.
        marks.append(op.now)
        yield from op.press(*SIDES)
        for _ in range(2 * times):  # Each turn has a pause and an engagement.
            op.lower |= set(SIDES)
            yield 0.03
            op.lower -= set(SIDES)
            yield 0.03

    marks: list[float] = []
    run = InStepRun(script, mode=CommandMode.TORQUE)
    assert run.reasons("lost") == []
    assert len(run.watch.engagements("left")) == times + 2
    resumed = [tick for tick in run.ticks if tick.t >= marks[0]]
    commanded = [run.loop.robot.tool_pose(tick.reference.q, "left").translation for tick in resumed]
    measured = np.array([tick.tools["left"].translation for tick in resumed])
    poses = [tick.targets["left"].pose for tick in resumed]
    targets = np.array([pose.translation for pose in poses if pose is not None])
    assert commanded[0][2] - measured[0][2] > 0.02
    assert np.linalg.norm(np.array(commanded) - commanded[0], axis=1).max() < 1e-6
    assert np.linalg.norm(targets - measured[0], axis=1).max() < 5e-6, "the target is where the tool is, not above"
    assert np.linalg.norm(measured - measured[0], axis=1).max() < 5e-6


@again_and_again
@pytest.mark.parametrize(
    ("mode", "mujoco", "load", "off"),
    [
        (CommandMode.TORQUE, {}, 42.0, 1e-3),
        # With soft joints, the sag of the tool depends on the posture. In the posture of rest at the end, the sag is
        # 2.6 mm larger.
        (CommandMode.POSITION, {"position_stiffness": 1500.0}, 75.0, 3.5e-3),
    ],
    ids=["on the spring of torque mode", "of soft joints"],
)
def test_a_sagging_arm_that_is_engaged_many_times_during_motion_keeps_its_sag_and_does_not_lag(
    mode: CommandMode, mujoco: dict[str, object], load: float, off: float, times: int
) -> None:
    """The hand moves to and fro at up to 0.6 m/s.

    In each direction it releases the dead man's switch for one sample, where the tool is fastest. The commands go on
    from the reference, and at the end the measured tool is at its target.
    """
    turns, sampled = 30, 0.014  # Number of samples in a cycle of the motion, and their period [s].

    def script(op: Operator) -> Iterator[float]:
        op.noise, op.period = 1e-9, sampled
        op.plant.push("left", np.array([0.0, 0.0, -load, 0.0, 0.0, 0.0]), 100.0)
        yield 1.4
        op.grip.add("left")
        yield 0.5 * turns * sampled
        start = op.hands["left"]
        for index in range((times // 2 + 1) * turns + 1):
            way = 0.04 * math.sin(2.0 * math.pi * index / turns)
            op.hands["left"] = pin.SE3(start.rotation, start.translation + np.array([0.0, way, 0.0]))
            (op.grip.discard if index > turns and index % (turns // 2) == 4 else op.grip.add)("left")
            yield sampled
        op.grip.add("left")
        yield 1.5

    run = InStepRun(script, mujoco, mode, bindings={"lower": "none", "grip": "dead_man"})
    assert run.reasons("lost") == []
    begins = run.watch.engagements("left")
    assert len(begins) == times + 1
    references = [run.loop.robot.tool_pose(tick.reference.q, "left").translation for tick in run.watch.ticks]
    for index in begins:
        way = math.dist(references[index - 1], references[index - 2])
        assert index == begins[0] or way > 0.35 * run.watch.ticks[index - 1].dt, "the arm moves when it is engaged"
        command = run.watch.ticks[index].targets["left"].command
        assert command is not None
        assert math.dist(command.translation, references[index - 1]) < 1e-9, "the command goes on from where it was"
    first, last = run.ticks[begins[0]], run.ticks[-1]
    assert references[begins[0]][2] - first.tools["left"].translation[2] > 0.018
    target = last.targets["left"].pose
    assert target is not None
    assert math.dist(last.tools["left"].translation, target.translation) < off


def test_an_arm_that_was_pushed_away_does_not_move_when_it_is_engaged() -> None:
    def script(op: Operator) -> Iterator[float]:
        yield 0.1
        op.plant.push("left", np.array([0.0, 140.0, 0.0, 0.0, 0.0, 0.0]), 2.0)
        yield 1.8
        yield from op.press("left")
        yield 2.0

    run = InStepRun(script, mode=CommandMode.TORQUE)
    first = run.ticks[run.watch.engagements("left")[0]].tools["left"].translation
    assert math.dist(first, run.ticks[0].tools["left"].translation) > MAX_OFFSET[0]
    assert math.dist(run.tool("left")[-1], first) < 0.005


def test_a_hand_drives_its_arm_along_the_axes_of_its_stance() -> None:
    def script(op: Operator) -> Iterator[float]:
        yield 0.1
        yield from op.press("left")
        yield from op.move((0.05, 0.04, 0.03), (0.0, 0.0, 0.3), seconds=0.5)
        yield 0.4

    run = InStepRun(script, stance="mirror_reflected")
    first, last = run.ticks[0].tools["right"], run.ticks[-1].tools["right"]
    np.testing.assert_allclose(last.translation - first.translation, [0.05, -0.04, 0.03], atol=1e-3)
    np.testing.assert_allclose(pin.log3(last.rotation @ first.rotation.T), [0.0, 0.0, -0.3], atol=5e-3)
    assert np.linalg.norm(run.tool("left") - run.tool("left")[0], axis=1).max() < 1e-6
