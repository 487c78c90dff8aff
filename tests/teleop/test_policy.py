"""Actions of a policy become targets.

Targets are interpolated between actions, and do not jump when a new chunk replaces the old one. Arms rest if no chunks
come.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pinocchio as pin
import pytest

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.events import CommonReason, Reason
from q2r2_control.quaternions import floats_of
from q2r2_control.teleop.policy_motion import SILENT
from q2r2_control.teleop.teleop import Teleop
from q2r2_control.types import SIDES, ActionChunk, ArmTarget, Array, HandSample
from tests.support.reasons import kinds
from tests.teleop.hands import pose, sample

TICK = 0.001
TOOLS = {"left": pose(0.5, 0.4, 0.4), "right": pose(0.5, -0.4, 0.4, (0.0, 0.0, 0.3))}
PERIOD = 0.05  # Period of actions [s].


def chunk(times: npt.ArrayLike, ways: Array, arms: tuple[str, ...] = SIDES, **more: object) -> ActionChunk:
    """Return a chunk with actions at ``times``. Its tool poses are ``ways`` (n,) [m] along x from :data:`TOOLS`."""
    tools = {arm: np.array([floats_of_moved(TOOLS[arm], way) for way in ways]) for arm in arms}
    return ActionChunk(np.array(times), PERIOD, tools=tools, **more)  # type: ignore[arg-type]


def floats_of_moved(tool: pin.SE3, way: float) -> tuple[float, ...]:
    (x, y, z), rotation = floats_of(tool)
    return (x + way, y, z, *rotation)


class Run:
    """A teleop layer with tools that reach each target by the next tick, unless ``blocked`` is True."""

    def __init__(self, settings: TeleopSettings | None = None) -> None:
        self.teleop = Teleop(settings or TeleopSettings(), SIDES)
        self.now = 10.0
        self.tools = dict(TOOLS)
        self.targets: dict[str, ArmTarget] = {}
        self.blocked = False

    def tick(self, *chunks: ActionChunk, samples: tuple[HandSample, ...] = ()) -> None:
        self.now += TICK
        self.targets = self.teleop.update(samples, self.tools, self.now, self.tools, chunks=chunks)
        if not self.blocked:
            self.tools |= {arm: target.pose for arm, target in self.targets.items() if target.pose is not None}

    def ways(self, seconds: float, *chunks: ActionChunk) -> Array:
        """Tick for ``seconds`` and return the left tool's displacement along x after each tick [m].

        The ``chunks`` come in the first tick.
        """
        found = []
        for _ in range(round(seconds / TICK)):
            self.tick(*chunks)
            chunks = ()
            found.append(self.tools["left"].translation[0] - TOOLS["left"].translation[0])
        return np.array(found)

    def states(self) -> set[str]:
        return {str(state) for state in self.teleop.states.values()}

    def reasons(self, arm: str = "left") -> list[str]:
        return [kinds(event.reason) for event in self.teleop.take_events() if event.arm == arm]


def test_the_first_target_is_the_tool_pose_and_each_action_is_reached_at_its_time() -> None:
    run = Run()
    times = run.now + TICK + PERIOD * np.arange(6)
    wanted = 0.1 * (times - times[0]) ** 2
    ways = run.ways(5.0 * PERIOD, chunk(times, wanted))
    assert run.states() == {"policy"}
    assert ways[0] == pytest.approx(0.0, abs=1e-12)
    for index in range(1, 5):
        assert ways[round(index * PERIOD / TICK)] == pytest.approx(wanted[index], abs=1e-9)
    assert np.abs(np.diff(ways)).max() < 0.1 * TICK


def test_a_newer_chunk_takes_over_at_the_time_of_its_first_action_without_a_jump() -> None:
    run = Run()
    start = run.now + TICK
    old = chunk(start + PERIOD * np.arange(20), np.zeros(20))
    new = chunk(start + 0.2 + PERIOD * np.arange(20), np.full(20, 0.03))
    ways = run.ways(0.5, old, new)
    assert np.abs(ways[:200]).max() < 1e-12
    assert ways[-1] == pytest.approx(0.03, abs=1e-9)
    assert np.abs(np.diff(ways)).max() <= 0.6 * TICK + 1e-9


def test_a_newer_chunk_replaces_a_chunk_that_has_not_begun_yet() -> None:
    run = Run()
    later = chunk(run.now + 0.3 + PERIOD * np.arange(10), np.full(10, 0.03))
    newer = chunk(run.now + PERIOD * np.arange(20), np.zeros(20))
    assert np.abs(run.ways(0.6, later, newer)).max() < 1e-12


def test_a_late_chunk_is_followed_from_its_present_action_and_a_chunk_that_has_ended_is_ignored() -> None:
    run = Run()
    past = chunk(run.now - 2.0 + PERIOD * np.arange(10), np.full(10, 0.05))
    run.ways(0.1, past)
    assert run.states() == {"idle"}
    late = chunk(run.now - 0.2 + PERIOD * np.arange(10), 0.01 * np.arange(10.0))
    ways = run.ways(0.2, late)
    assert ways[-1] == pytest.approx(0.08, abs=1e-3)


def test_relative_motions_start_at_the_last_target_and_a_single_late_motion_is_executed_fully() -> None:
    run = Run()
    motion = np.tile([0.01, 0.0, 0.0, 0.0, 0.0, 0.2], (1, 1))
    for index in range(5):
        run.ways(PERIOD, ActionChunk(np.array([run.now - 0.02]), PERIOD, motions=dict.fromkeys(SIDES, motion)))
        turned = pin.log3(TOOLS["left"].rotation.T @ run.tools["left"].rotation)
        assert turned[2] == pytest.approx(0.2 * (index + 1), rel=0.05)


def test_arms_stop_if_their_policy_is_silent_and_move_again_with_a_chunk_from_the_tool_poses() -> None:
    run = Run()
    run.ways(0.1, chunk(np.array([run.now]), np.array([0.01])))
    run.ways(SILENT - 0.11)
    assert run.states() == {"policy"}
    run.ways(0.02)
    assert run.states() == {"lost"}
    assert all(target.pose is None for target in run.targets.values())
    assert run.reasons() == ["policy_acts", "policy_silent"]
    run.ways(0.1, chunk(np.array([run.now]), np.array([0.02])))
    assert run.states() == {"policy"}


@pytest.mark.parametrize(
    ("way", "reason"),
    [(np.array([0.2]), "policy_jumped"), (np.array([0.0, 0.0, 0.16]), "policy_jumped")],
    ids=["from the tool", "between two actions"],
)
def test_an_action_that_jumps_stops_both_arms_and_is_not_followed(way: Array, reason: str) -> None:
    run = Run()
    run.ways(0.1, chunk(np.array([run.now]), np.array([0.0])))
    before = run.tools["left"]
    run.ways(0.1, chunk(run.now + PERIOD * np.arange(len(way)), way, arms=("left",)))
    assert run.states() == {"lost"}
    assert run.tools["left"] is before
    assert run.reasons() == ["policy_acts", reason]
    assert run.reasons("right") == []


# Displacements of the left tool along x, for four actions [m].
STAYS, JUMPS, JUMPS_LATER = np.zeros(4), np.full(4, 1.0), np.array([0.0, 0.0, 1.0, 1.0])


def for_both(run: Run, left: Array) -> ActionChunk:
    """Return one chunk for both arms: ``left`` has the displacements of the left tool, and the right tool stays."""
    times = np.array(run.now + PERIOD * np.arange(4), dtype=np.float64)
    ways = zip(SIDES, (left, STAYS), strict=True)
    tools = {arm: chunk(times, its, (arm,)).tools[arm] for arm, its in ways}
    return ActionChunk(times, PERIOD, tools=tools)


@pytest.mark.parametrize("left", [JUMPS, JUMPS_LATER], ids=["from the tool", "between two actions"])
@pytest.mark.parametrize("before", [0.1, 0.0], ids=["after both followed", "from the first chunk on"])
def test_linked_arms_begin_to_follow_a_policy_together_or_not_at_all(before: float, left: Array) -> None:
    run = Run()
    run.ways(before, *[for_both(run, STAYS)] * (before > 0.0))
    for _ in range(5):
        run.ways(0.1, for_both(run, left))
        assert run.states() <= {"lost", "idle"}
    run.ways(2.0 * TICK, for_both(run, STAYS))
    assert run.states() == {"policy"}


def test_linked_arms_do_not_follow_a_chunk_for_only_one_arm_after_a_fault() -> None:
    run = Run()
    run.ways(0.1, for_both(run, STAYS))
    run.ways(0.1, for_both(run, JUMPS))
    run.ways(0.1, chunk(run.now + PERIOD * np.arange(4), np.zeros(4), ("right",)))
    assert run.states() == {"lost"}


def test_an_arm_that_is_not_linked_goes_on_when_the_other_arm_has_a_fault() -> None:
    run = Run(TeleopSettings(linked=False))
    run.ways(0.1, for_both(run, STAYS))
    run.ways(0.1, for_both(run, JUMPS))
    run.ways(0.1, for_both(run, JUMPS))
    assert {arm: str(state) for arm, state in run.teleop.states.items()} == {"left": "lost", "right": "policy"}


def test_unusable_actions_are_reported_once_while_no_arm_follows_the_policy() -> None:
    run = Run()
    fault = ActionChunk(np.zeros(0), PERIOD, fault=Reason.of(CommonReason.POLICY_UNUSABLE, text="no numbers"))
    for _ in range(10):
        run.tick(fault)
    assert run.states() == {"idle"}
    assert run.reasons() == ["policy_refused: policy_unusable"]


def test_actions_are_refused_if_their_times_are_not_times_of_the_loops_clock() -> None:
    run = Run()
    run.tick(chunk(np.array([run.now + 1e9]), np.array([0.0])))
    assert run.reasons() == ["policy_refused: policy_unusable"]


def test_a_gripper_moves_at_the_time_of_its_action() -> None:
    run = Run()
    openings = {"left": np.array([1.0, 0.25])}
    run.ways(PERIOD - 2 * TICK, chunk([run.now, run.now + PERIOD], np.zeros(2), grippers=openings))
    assert run.targets["left"].gripper == 1.0
    run.ways(4 * TICK)
    assert run.targets["left"].gripper == 0.25
    assert run.targets["right"].gripper == 1.0


def test_the_target_follows_a_parabola_through_the_actions_along_all_axes() -> None:
    run = Run()
    run.now = 0.0
    way, times = np.array([0.1, -0.2, 0.3]), np.array([TICK + PERIOD * index for index in range(8)])

    def place(t: float) -> Array:
        return TOOLS["left"].translation + way * (t - times[0]) ** 2

    actions = np.array([(*place(t), *floats_of(TOOLS["left"])[1]) for t in times])
    run.tick(ActionChunk(times, PERIOD, tools={"left": actions}))
    while run.now < times[-2]:
        run.tick()
        # The velocity at the first action is unknown. The mean velocity up to the second action replaces it.
        allowed = 2e-4 if run.now < times[1] else 1e-9
        np.testing.assert_allclose(run.tools["left"].translation, place(run.now), atol=allowed)


def test_a_tap_takes_over_an_arm_and_a_second_tap_closes_the_gripper_that_the_policy_opened() -> None:
    run = Run()

    def hands(lower: bool = False, upper: bool = False) -> tuple[HandSample, ...]:
        return tuple(sample(hand, pose(), run.now + TICK, lower=lower, upper=upper) for hand in SIDES)

    for _ in range(50):
        run.tick(samples=hands())
    openings = {side: np.array([0.5, 1.0]) for side in SIDES}
    still = chunk(run.now + PERIOD * np.arange(2), np.zeros(2), grippers=openings)
    run.tick(still, samples=hands())
    for _ in range(60):
        run.tick(samples=hands())
    assert run.states() == {"policy"}
    for tick in range(300):
        run.tick(samples=hands(lower=tick < 100))
    assert run.states() == {"engaged"}
    assert [run.targets[arm].gripper for arm in SIDES] == [1.0, 1.0]
    for tick in range(200):
        run.tick(samples=hands(upper=tick < 100))
    assert [run.targets[arm].gripper for arm in SIDES] == [0.0, 0.0]


def test_the_leash_holds_the_target_near_a_blocked_tool() -> None:
    run = Run()
    run.blocked = True
    times = run.now + PERIOD * np.arange(20)
    run.ways(0.9, chunk(times, 0.01 * np.arange(20.0)))
    target = run.targets["left"].pose
    assert target is not None
    assert target.translation[0] - TOOLS["left"].translation[0] == pytest.approx(0.1)


def test_targets_stay_in_the_workspace() -> None:
    box = {"x": [0.3, 0.52], "y": [0.0, 0.6], "z": [0.1, 0.7]}
    run = Run(TeleopSettings.model_validate({"workspace": {"left": box}}))
    assert run.ways(0.9, chunk(run.now + PERIOD * np.arange(20), 0.004 * np.arange(20.0))).max() == pytest.approx(0.02)


def test_after_a_hands_data_have_ended_a_policy_may_move_the_hands_arm_only_after_a_press() -> None:
    run = Run()

    def hands(lower: bool) -> tuple[HandSample, ...]:
        return tuple(sample(hand, pose(), run.now + TICK, lower=lower) for hand in SIDES)

    for k in range(400):
        run.tick(samples=hands(50 <= k < 150))
    assert run.states() == {"engaged"}
    run.ways(0.3, chunk(run.now + PERIOD * np.arange(20), np.zeros(20)))
    assert run.states() == {"lost"}
    run.ways(0.3, chunk(run.now + PERIOD * np.arange(20), np.zeros(20)))
    assert run.states() == {"lost"}
