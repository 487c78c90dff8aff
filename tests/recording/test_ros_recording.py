"""Recordings of ROS nodes: what is in the file, and what judge, export and replay make of it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import yaml

from q2r2_control.config.cell import parse_config
from q2r2_control.config.recording import CameraConfig
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.errors import RecordingError
from q2r2_control.events import ReasonKind as K
from q2r2_control.export.episodes import FrameSampling, make_episode
from q2r2_control.judging.judge import judge
from q2r2_control.recording import topics as names
from q2r2_control.recording.episode_spans import read_spans
from q2r2_control.recording.reader import TickChunk
from q2r2_control.recording.replay import replay
from q2r2_control.recording.ros_recording import open_recording
from q2r2_control.recording.topics import arm_flags
from tests.recording.ros_runs import PERIOD, NodesOnFile
from tests.recording.runs import read_elsewhere
from tests.support.external_cell import external
from tests.support.processes import cell

pytestmark = pytest.mark.slow

SECOND = 1_000_000_000  # [ns]


def play(nodes: NodesOnFile, count: int = 250, first: int = 5, index: int = 1, engaged: range = range(0)) -> None:
    """Ticks ``first`` .. of 4 ms, at which joint i of the reference is at home + 1 mrad a tick, measured one behind."""
    home = np.array(nodes.robot.home)
    for place in range(first, first + count):
        at = place * PERIOD
        nodes.joint_states(at - PERIOD // 2, home + 1e-3 * (place - 1))
        for arm in nodes.arms:
            nodes.flags(at - PERIOD // 4, arm, place in engaged)
        if place in engaged:
            nodes.target(at - PERIOD // 4, "left", float(place))
        nodes.tick(at, index + place - first, home + 1e-3 * place)


def ticks_in(path: Path) -> list[TickChunk]:
    return [chunk for chunk in open_recording(path).chunks() if len(chunk.rows)]


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


@pytest.fixture
def nodes(tmp_path: Path) -> NodesOnFile:
    return NodesOnFile(tmp_path)


def test_each_message_is_in_the_file_as_it_came_with_the_times_of_its_receipt_and_sending(
    nodes: NodesOnFile, tmp_path: Path
) -> None:
    play(nodes, 20)
    file = nodes.close()
    found = read_elsewhere(file.parent, tmp_path)
    assert found[names.JOINT_STATES]["count"] == found[names.REFERENCE]["count"] == 20
    assert found[names.JOINT_STATES]["first"] == nodes.epoch + 5 * PERIOD - PERIOD // 2
    assert found[names.REFERENCE]["type"] == "trajectory_msgs/msg/JointTrajectory"


def test_a_message_that_was_received_before_the_last_one_keeps_the_order_of_the_file(
    nodes: NodesOnFile, tmp_path: Path
) -> None:
    nodes.flags(5 * SECOND, "left", True)
    nodes.flags(4 * SECOND, "right", True)
    found = read_elsewhere(nodes.close().parent, tmp_path)
    assert found[arm_flags("right")]["first"] == nodes.epoch + 5 * SECOND


def test_a_tick_has_the_reference_of_its_time_and_what_had_been_received_by_then(nodes: NodesOnFile) -> None:
    home = np.array(nodes.robot.home)
    play(nodes, 100, engaged=range(40, 60))
    (ticks,) = ticks_in(nodes.close())
    assert ticks.numbers.tolist() == list(range(100))
    places = np.arange(5, 105)
    assert ticks.rows["reference_q"] == pytest.approx(home + 1e-3 * places[:, None])
    assert ticks.rows["q"] == pytest.approx(home + 1e-3 * (places[:, None] - 1))
    engaged = ticks.rows["arms"]["engaged"][:, 0] > 0.5
    assert np.flatnonzero(engaged).tolist() == list(range(35, 55))
    targets = ticks.rows["arms"]["target"][:, 0, 0]
    assert targets[engaged].tolist() == list(range(40, 60))
    assert not targets[~engaged].any()


def test_a_target_that_ceased_is_none_of_a_later_tick(nodes: NodesOnFile) -> None:
    play(nodes, 10, engaged=range(5, 15))
    later = 15 * PERIOD + round(STREAM_TIMEOUT * SECOND)
    nodes.flags(later - 1000, "left", True)
    nodes.tick(later, 11, np.array(nodes.robot.home))
    (ticks,) = ticks_in(nodes.close())
    assert ticks.rows["arms"]["engaged"][:, 0].all()
    assert ticks.rows["arms"]["target"][:, 0].any(axis=1).tolist() == [True] * 10 + [False]


def test_a_tick_whose_reference_was_lost_counts_as_lost_and_what_happened_in_it_does_not(nodes: NodesOnFile) -> None:
    play(nodes, 10)
    nodes.event(15 * PERIOD - 1000, K.MARK)
    lost = nodes.topics.pop(names.REFERENCE)
    with pytest.raises(KeyError):
        nodes.tick(15 * PERIOD, 11, np.array(nodes.robot.home))
    nodes.topics[names.REFERENCE] = lost
    play(nodes, 10, first=16, index=12)
    (ticks,) = ticks_in(nodes.close())
    assert ticks.numbers.tolist() == [*range(10), *range(11, 21)]
    assert len(ticks.states) == 1


def test_a_controller_that_was_started_again_begins_with_the_next_number(nodes: NodesOnFile) -> None:
    play(nodes, 10, index=500)
    play(nodes, 10, first=100, index=1)
    (ticks,) = ticks_in(nodes.close())
    assert ticks.numbers.tolist() == list(range(20))


def test_nothing_is_a_tick_before_the_joints_and_the_arms_flags_are_known(nodes: NodesOnFile) -> None:
    nodes.tick(PERIOD, 1, np.array(nodes.robot.home))
    play(nodes, 5, index=2)
    (ticks,) = ticks_in(nodes.close())
    assert len(ticks.numbers) == 5


def test_episodes_are_those_that_arms_and_services_tell_of(nodes: NodesOnFile) -> None:
    for at, kind, arm in (
        *((20, K.EPISODE_BEGINS, "left"), (60, K.MARK, "right"), (80, K.EPISODE_ENDS, "right")),
        *((100, K.EPISODE_BEGINS, None), (120, K.EPISODE_DISCARDED, None)),
    ):
        play(nodes, 15, first=at - 15, index=at)
        nodes.event(at * PERIOD, kind, arm)
    play(nodes, 10, first=130, index=200)
    recording = open_recording(nodes.close())
    first, second = read_spans(recording)
    assert (first.start, first.end, first.discarded) == (pytest.approx(0.08), pytest.approx(0.32), False)
    assert second.discarded
    kept, discarded = judge(recording)
    assert kept.figures.part == 1
    assert "operator" in [reason.name for reason in discarded.verdict.reasons]


def test_episodes_are_found_where_no_controller_was_active(nodes: NodesOnFile) -> None:
    nodes.event(PERIOD, K.EPISODE_BEGINS)
    nodes.event(5 * PERIOD, K.EPISODE_ENDS, None)
    (span,) = read_spans(open_recording(nodes.close()))
    assert (span.start, span.end) == (pytest.approx(0.004), pytest.approx(0.02))


def test_an_episode_is_judged_by_its_messages(nodes: NodesOnFile) -> None:
    engaged = range(50, 240)
    play(nodes, 250, engaged=engaged)
    recording = open_recording(nodes.close())
    (judged,) = judge(recording)
    assert judged.figures.timing.ticks == 250
    assert judged.figures.timing.missed_ticks == 0
    assert judged.figures.timing.ended
    assert judged.figures.arms["left"].engaged_s == pytest.approx(len(engaged) * PERIOD * 1e-9, abs=0.01)


def test_a_known_step_is_in_action_and_observation_at_the_frames_of_its_times(nodes: NodesOnFile) -> None:
    home = np.array(nodes.robot.home)
    for place in range(1, 101):
        at, step = place * PERIOD, 0.1 * (place >= 50)
        nodes.joint_states(at - 1000, home + 0.1 * (place > 52))
        for arm in nodes.arms:
            nodes.flags(at - 500, arm, False, wanted=float(place < 60), measured=float(place < 70))
        nodes.tick(at, place, home + step)
    episode = make_episode(nodes.close(), FrameSampling(fps=250))
    action, state = (episode.vectors[name] for name in ("action", "observation.state"))
    moved = [int(np.argmax(np.abs(vector[:, 0] - home[0]) > 0.05)) for vector in (action, state)]
    assert moved == [49, 52]
    closed = [int(np.argmax(vector[:, -1] < 0.5)) for vector in (action, state)]
    assert closed == [59, 69]
    assert episode.task == "to count"


def test_what_a_killed_writer_leaves_opens_and_has_no_end(nodes: NodesOnFile) -> None:
    play(nodes, 250)
    recorder = nodes.recorder
    assert recorder.writer is not None
    wait_for(lambda: recorder.written.messages > 0)
    os.kill(recorder.writer.pid, signal.SIGKILL)
    recorder.finish()
    assert "SIGKILL" in str(recorder.fault)
    assert recorder.file is not None
    recording = open_recording(recorder.file)
    assert not recording.closed
    assert ticks_in(recorder.file)[0].numbers[0] == 0


def test_messages_without_room_are_lost_and_counted(tmp_path: Path) -> None:
    nodes = NodesOnFile(tmp_path, room=1 << 16)
    assert nodes.recorder.writer is not None
    os.kill(nodes.recorder.writer.pid, signal.SIGSTOP)
    play(nodes, 100)
    assert nodes.recorder.overflows > 0
    os.kill(nodes.recorder.writer.pid, signal.SIGCONT)
    nodes.close()
    assert nodes.recorder.written.messages == nodes.recorder.count - nodes.recorder.overflows


def test_a_replay_is_refused_in_one_line(nodes: NodesOnFile) -> None:
    play(nodes, 5)
    with pytest.raises(RecordingError, match=r"recorded from ROS nodes.*nothing to replay"):
        replay(nodes.close())


def test_what_another_controller_moved_is_refused_in_one_line(tmp_path: Path) -> None:
    nodes = NodesOnFile(tmp_path, parse_config(yaml.safe_dump(external()), "the cell"))
    play(nodes, 5)
    with pytest.raises(RecordingError, match="recorded with controller: external"):
        ticks_in(nodes.close())


def test_pictures_that_are_not_compressed_cannot_be_exported_and_are_named(tmp_path: Path) -> None:
    nodes = NodesOnFile(
        tmp_path, cell().model_copy(update={"cameras": {"front": CameraConfig(topic="/front/image_raw")}})
    )
    play(nodes, 5)
    with pytest.raises(RecordingError, match=r"camera front are sensor_msgs/Image.*--no-pictures"):
        list(open_recording(nodes.close()).pictures("front"))
