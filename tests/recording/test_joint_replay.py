"""Recorded references sent to a plant: followed where the controller's promises allow, held back and told elsewhere."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.recording.joint_replay import JointReplay, replay_joints
from q2r2_control.recording.messages import Message
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorded_ticks import RecordedTicks
from q2r2_control.recording.tick_rows import tick_type
from q2r2_control.recording.topics import TICK
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.recording.runs import ARMS, JOINTS, RATE, file_of, pipeline, record, rewrite
from tests.support.watch import Watch, cell

pytestmark = pytest.mark.slow

Change = Callable[[int, Array, Array], None]


@pytest.fixture(scope="module")
def circle(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Both arms on a circle for a second."""
    return file_of(record(tmp_path_factory.mktemp("recordings"), pipeline(), 2.2))


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(cell())


def edited(file: Path, target: Path, change: Change) -> Path:
    """A copy whose references were changed: ``change`` gets each one's number, positions and velocities."""

    def change_message(topic: str, message: Message) -> Message:
        if topic != TICK:
            return message
        kind = tick_type(len(ARMS), len(JOINTS))
        numbers = bytearray(message.payload[-kind.itemsize :])
        (row,) = np.frombuffer(numbers, dtype=kind)
        change(message.number, row["reference_q"], row["reference_v"])
        return message._replace(payload=message.payload[: -kind.itemsize] + bytes(numbers))

    return rewrite(file, target, change_message)


def played(file: Path, plant: str = "kinematic", config: Config | None = None) -> tuple[JointReplay, Watch]:
    """What became of the references; the contract was checked at every tick."""
    watches: list[Watch] = []
    result = replay_joints(file, plant, config, lambda pipeline: watches.append(Watch(pipeline)))
    assert result.summary is not None
    assert result.summary.at_rest
    return result, watches[0]


def references(file: Path) -> Array:
    ticks = RecordedTicks(Recording(file))
    found = []
    while ticks.next is not None:
        found.append(ticks.advance().reference_q)
    return np.array(found)


@pytest.mark.parametrize("plant", ["kinematic", "mujoco"])
def test_references_that_keep_the_promises_are_followed_one_by_one(circle: Path, plant: str) -> None:
    result, watch = played(circle, plant)
    recorded = references(circle)
    assert (result.whole, result.notes, result.references) == (True, [], len(recorded))
    assert result.farthest_rad < 1e-5
    assert np.ptp(recorded, axis=0).max() > 0.05
    sent = np.array([tick.command.q for tick in watch.ticks])
    assert min(np.abs(sent - recorded[-1]).max(axis=1)) < 1e-5


def test_the_arms_first_travel_to_the_first_reference(circle: Path) -> None:
    arms = dict(cell().arms)
    home = list(arms["left"].home)
    home[1] += 0.2
    arms["left"] = arms["left"].model_copy(update={"home": tuple(home)})
    config = cell().model_copy(update={"loop_rate_hz": RATE, "arms": arms})
    result, watch = played(circle, config=config)
    assert result.whole
    assert len(watch.ticks) > result.references + 0.2 / 0.3 * RATE
    assert any(note.startswith("cell: arms.left.home") for note in result.notes)


def test_a_reference_that_is_no_number_or_jumps_is_held_back_alone_and_said(tmp_path: Path, circle: Path) -> None:
    def change(number: int, q: Array, v: Array) -> None:
        if number == 850:
            q[2] = np.nan
        if number == 860:
            v[3] = np.inf
        if 900 <= number < 910:
            q[4] += 1.0
        if number == 930:
            v[5] = 1e6

    result, _ = played(edited(circle, tmp_path / "hostile.mcap", change))
    assert [held.references for held in result.held_back] == [1, 1, 10, 1]
    assert [held.reasons for held in result.held_back] == [
        ["left_A3 is no finite number"],
        ["left_A4 is no finite number"],
        ["left_A5 jumps"],
        ["left_A6 is faster than its limit"],
    ]
    assert result.held_back[2].start_s == pytest.approx(901 / RATE)
    assert result.ended_by is None
    assert result.farthest_rad < 0.01


def test_arms_do_not_go_after_references_that_jumped_away_for_good(tmp_path: Path, circle: Path) -> None:
    def change(number: int, q: Array, v: Array) -> None:
        if number >= 900:
            q[0] += 1.0

    result, watch = played(edited(circle, tmp_path / "away.mcap", change))
    (held,) = result.held_back
    assert (held.references, result.references) == (result.references - 900, len(references(circle)))
    assert np.abs(watch.ticks[-1].reference.q - references(circle)[899]).max() < 0.01


def test_references_that_make_the_arms_meet_are_held_back_by_what_they_would_touch(
    tmp_path: Path, circle: Path, robot: Robot
) -> None:
    recorded = references(circle)
    meet = robot.home.copy()
    for arm, turn in (("left", -1.2), ("right", 1.2)):
        meet[robot.arms[arm].joints[0]] += turn
    assert robot.distance_values(meet).min() < 0.0
    step = (meet - recorded[100]) / 500

    def change(number: int, q: Array, v: Array) -> None:
        if number >= 100:
            q[:] = recorded[100] + min(number - 100, 500) * step
            v[:] = step * RATE * (number < 600)

    result, watch = played(edited(circle, tmp_path / "meet.mcap", change))
    assert result.ended_by is None
    assert "left" in (pair := " ".join(result.held_back[-1].reasons))
    assert "|" in pair
    assert min(tick.reference.report.margin for tick in watch.ticks) >= 0.0
    assert max(held.farthest_rad for held in result.held_back) > 0.1


def test_a_first_reference_that_nothing_can_get_to_ends_it_with_the_reason(tmp_path: Path, circle: Path) -> None:
    def never(number: int, q: Array, v: Array) -> None:
        q[0] = np.nan

    result, _ = played(edited(circle, tmp_path / "never.mcap", never))
    assert (result.references, result.whole) == (0, False)
    assert result.ended_by == "the first reference is not sent: left_A1 is no finite number"
