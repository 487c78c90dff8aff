"""Recordings of ROS nodes: what the file contains, and how judge, export and replay use it."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from q2r2_control import Robot
from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import parse_config
from q2r2_control.config.recording import CameraConfig
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.errors import RecordingError
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.export.episodes import FrameSampling, make_episode
from q2r2_control.judging.judge import judge
from q2r2_control.recording import messages as names
from q2r2_control.recording.about import ROS, About, as_yaml
from q2r2_control.recording.reader import read_spans
from q2r2_control.recording.recorder import ROOM, MessageRecorder
from q2r2_control.recording.replay import replay
from q2r2_control.recording.ros_recording import open_recording
from q2r2_control.recording.tick_chunks import TickChunk
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import Array
from tests.recording.runs import read_elsewhere, rewrite
from tests.support.external_cell import external
from tests.support.processes import cell

PERIOD = 4_000_000  # Period of ticks [ns].
LATENCY = 100_000  # Time from a tick to the receipt of its messages [ns].


class NodesOnFile:
    """Records messages as ROS nodes send them. The times ``at`` count from the start of the recording [ns]."""

    def __init__(self, folder: Path, config: Config | None = None, room: int = ROOM) -> None:
        self.config = (config or cell()).model_copy(update={"loop_rate_hz": 250.0})
        self.robot = Robot.from_config(self.config)
        self.arms, self.joints = tuple(self.robot.arms), tuple(self.robot.joint_names)
        self.epoch = time.time_ns()
        self.recorder = MessageRecorder(folder, self.config.name, room)
        about = About(
            *(self.arms, self.joints, "", (), self.epoch, True, as_yaml(self.config), self.robot.urdf),
            cameras=tuple(self.config.cameras),
            notes={"task": "to count"},
            source=ROS,
        )
        topics = names.ros_topics(self.arms, [camera.topic or "" for camera in self.config.cameras.values()])
        self.topics = {topic.name: topic for topic in topics}
        self.recorder.begin(about, topics)
        self._number = 0

    def close(self) -> Path:
        self.recorder.finish()
        assert self.recorder.fault is None
        assert self.recorder.file is not None
        return self.recorder.file

    def put(self, topic: str, at: int, message: Any) -> None:
        self._number += 1
        time, payload = self.epoch + at, names.serialized(self.topics[topic].type, message)
        self.recorder.record([names.Message(self.topics[topic].channel, self._number, time, time, payload)])

    def joint_states(self, at: int, q: Array) -> None:
        """Record joint states in another order than the robot's, with a joint that the robot does not have."""
        order = [*reversed(self.joints), "left_finger_joint_1"]
        values = dict(zip(self.joints, q, strict=True))
        position = np.array([values.get(name, 0.5) for name in order])
        self.put(names.JOINT_STATES, at, names.joint_state(order, position, 0 * position, 0 * position))

    def tick(self, at: int, index: int, q: Array, v: Array | None = None, **values: float) -> None:
        """Record a tick of the controller: its reference and its numbers."""
        now = (self.epoch + at) * 1e-9
        zero = np.zeros(len(self.joints))
        reference = names.joint_trajectory(list(self.joints), q, zero if v is None else v, zero, round(now * 1e9))
        self.put(names.REFERENCE, at + LATENCY, reference)
        numbers = dict.fromkeys(names.tick_fields(self.arms), 0.0)
        numbers |= {"index": index, "now": now, "dt": PERIOD * 1e-9, "step": PERIOD * 1e-9, "certified": 1.0}
        numbers |= {"closest_distance": 0.2, "margin": 0.18} | values
        self.put(names.CONTROLLER_TICK, at + LATENCY, names.float_array(np.array(list(numbers.values()))))

    def flags(self, at: int, arm: str, engaged: bool, wanted: float = 1.0, measured: float = 1.0) -> None:
        self.put(names.arm_flags(arm), at, names.float_array(np.array([engaged, 0.0, 0.0, wanted, measured])))

    def pose(self, topic: str, at: int, x: float) -> None:
        pose = np.array([x, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0])
        self.put(topic, at, names.pose_stamped(pose, stamp=self.epoch + at))

    def event(self, at: int, kind: ReasonKind, arm: str | None = "left") -> None:
        topic = names.RECORDER_EVENTS if arm is None else names.arm_events(arm)
        event = Event(123.0, arm or "", "", "", Reason(kind))  # Readers do not use this time of the sender's clock.
        self.put(topic, at, names.make(names.TEXT, json.dumps(event.as_json())))


pytestmark = pytest.mark.slow

SECOND = 1_000_000_000  # [ns]


def play(nodes: NodesOnFile, count: int = 250, first: int = 5, index: int = 1, engaged: range = range(0)) -> None:
    """Record ``count`` ticks of 4 ms. Tick ``first`` is due ``first`` periods after the beginning.

    The reference of each joint moves away from home by 1 mrad a tick. The measured joints follow one tick later. The
    arms are engaged in the ticks ``engaged``. The controller's own index of tick ``first`` is ``index``.
    """
    home = np.array(nodes.robot.home)
    for place in range(first, first + count):
        at = place * PERIOD
        nodes.joint_states(at - PERIOD // 2, home + 1e-3 * (place - 1))
        for arm in nodes.arms:
            nodes.flags(at - PERIOD // 4, arm, place in engaged)
        if place in engaged:
            nodes.pose(names.target("left"), at - PERIOD // 4, float(place))
            nodes.pose(names.hand_pose("left"), at - PERIOD // 4, float(place))
        nodes.tick(at, index + place - first, home + 1e-3 * place)


def ticks_in(path: Path) -> list[TickChunk]:
    return [chunk for chunk in open_recording(path).chunks() if len(chunk.rows)]


@pytest.fixture
def nodes(tmp_path: Path) -> NodesOnFile:
    return NodesOnFile(tmp_path)


def test_each_message_is_in_the_file_unchanged_and_in_the_order_of_receipt(nodes: NodesOnFile, tmp_path: Path) -> None:
    play(nodes, 20)
    nodes.flags(5 * SECOND, "left", True)
    nodes.flags(4 * SECOND, "right", True)
    file = nodes.close()
    found = read_elsewhere(file.parent, tmp_path)
    assert found[names.JOINT_STATES]["count"] == found[names.REFERENCE]["count"] == 20
    assert found[names.JOINT_STATES]["first"] == nodes.epoch + 5 * PERIOD - PERIOD // 2
    assert found[names.REFERENCE]["type"] == "trajectory_msgs/msg/JointTrajectory"
    assert found[names.arm_flags("right")]["last"] == nodes.epoch + 5 * SECOND


def test_a_tick_has_the_reference_of_its_time_and_the_messages_received_by_then(nodes: NodesOnFile) -> None:
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
    assert ticks.samples[:, names.SAMPLE_FIELDS.index("x")].tolist() == list(range(40, 60))


def test_ticks_after_the_timeout_of_a_target_stream_have_no_target(nodes: NodesOnFile) -> None:
    play(nodes, 10, engaged=range(5, 15))
    later = 15 * PERIOD + round(STREAM_TIMEOUT * SECOND)
    nodes.flags(later - 1000, "left", True)
    nodes.tick(later, 11, np.array(nodes.robot.home))
    (ticks,) = ticks_in(nodes.close())
    assert ticks.rows["arms"]["engaged"][:, 0].all()
    assert ticks.rows["arms"]["target"][:, 0].any(axis=1).tolist() == [True] * 10 + [False]


def test_a_tick_whose_reference_was_lost_counts_as_lost_but_its_events_are_kept(nodes: NodesOnFile) -> None:
    play(nodes, 10)
    nodes.event(15 * PERIOD - 1000, TeleopReason.MARK)
    lost = nodes.topics.pop(names.REFERENCE)
    with pytest.raises(KeyError):
        nodes.tick(15 * PERIOD, 11, np.array(nodes.robot.home))
    nodes.topics[names.REFERENCE] = lost
    play(nodes, 10, first=16, index=12)
    (ticks,) = ticks_in(nodes.close())
    assert ticks.numbers.tolist() == [*range(10), *range(11, 21)]
    assert len(ticks.states) == 1


def test_ticks_count_only_after_joints_and_flags_are_known_and_the_count_continues_after_a_restart(
    nodes: NodesOnFile,
) -> None:
    nodes.tick(PERIOD, 499, np.array(nodes.robot.home))
    play(nodes, 10, index=500)
    play(nodes, 10, first=100, index=1)
    (ticks,) = ticks_in(nodes.close())
    assert ticks.numbers.tolist() == list(range(20))


def test_ticks_are_kept_even_if_the_robot_does_not_measure_some_numbers(nodes: NodesOnFile) -> None:
    """A tick also keeps a position that is not finite, so that the judge finds it."""
    play(nodes, 5)
    nothing, q = np.full(len(nodes.joints), np.nan), np.array(nodes.robot.home)
    for place, position in ((10, q), (11, nothing)):
        message = names.joint_state(list(nodes.joints), position, nothing, nothing)
        nodes.put(names.JOINT_STATES, place * PERIOD - 1, message)
        nodes.tick(place * PERIOD, place - 4, q)
    (ticks,) = ticks_in(nodes.close())
    assert len(ticks.rows) == 7
    assert not ticks.rows["tau"].any()
    assert not ticks.rows["v"].any()
    assert np.isnan(ticks.rows["q"]).all(axis=1).tolist() == [False] * 6 + [True]


def test_events_of_arms_and_of_services_begin_and_end_episodes(nodes: NodesOnFile) -> None:
    for at, kind, arm in (
        *(
            (20, TeleopReason.EPISODE_BEGINS, "left"),
            (60, TeleopReason.MARK, "right"),
            (80, TeleopReason.EPISODE_ENDS, "right"),
        ),
        *((100, TeleopReason.EPISODE_BEGINS, None), (120, TeleopReason.EPISODE_DISCARDED, None)),
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


def test_episodes_are_found_even_if_no_controller_was_active(nodes: NodesOnFile) -> None:
    nodes.event(PERIOD, TeleopReason.EPISODE_BEGINS)
    nodes.event(5 * PERIOD, TeleopReason.EPISODE_ENDS, None)
    (span,) = read_spans(open_recording(nodes.close()))
    assert (span.start, span.end) == (pytest.approx(0.004), pytest.approx(0.02))


def test_an_episode_is_judged_from_its_messages_and_cannot_be_replayed(nodes: NodesOnFile) -> None:
    engaged = range(50, 240)
    play(nodes, 250, engaged=engaged)
    file = nodes.close()
    (judged,) = judge(open_recording(file))
    assert (judged.figures.timing.ticks, judged.figures.timing.missed_ticks) == (250, 0)
    assert judged.figures.timing.ended
    assert judged.figures.arms["left"].engaged_s == pytest.approx(len(engaged) * PERIOD * 1e-9, abs=0.01)
    assert judged.figures.hands["left"].pose_rate_hz == pytest.approx(250.0, rel=0.02)
    with pytest.raises(RecordingError, match=r"recorded from ROS nodes.*nothing to replay"):
        replay(file)


def test_a_step_of_the_joints_is_exported_in_the_frames_of_its_time(nodes: NodesOnFile) -> None:
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


@pytest.mark.parametrize("step", [5 * SECOND, -SECOND // 4], ids=["forward", "back"])
def test_an_episode_in_which_the_clock_was_set_is_discarded_but_the_next_episode_can_be_exported(
    nodes: NodesOnFile, tmp_path: Path, step: int
) -> None:
    nodes.event(1, TeleopReason.EPISODE_BEGINS)
    play(nodes, 200, engaged=range(5, 205))
    nodes.event(205 * PERIOD, TeleopReason.EPISODE_ENDS)
    nodes.event(206 * PERIOD, TeleopReason.EPISODE_BEGINS)
    play(nodes, 100, first=207, index=201, engaged=range(207, 300))
    border = nodes.epoch + 104 * PERIOD

    def set_clock(_: str, message: names.Message) -> names.Message:
        return message._replace(time=message.time + step * (message.time > border))

    recording = open_recording(rewrite(nodes.close(), tmp_path / "stepped.mcap", set_clock))
    assert sum(len(chunk.rows) for chunk in recording.chunks()) == 300
    spoiled, clean = judge(recording)
    set_by = f"a clock was set {'forward' if step > 0 else 'back'}"
    assert any(set_by in reason.text for reason in spoiled.verdict.reasons)
    assert not any("clock" in reason.text for reason in clean.verdict.reasons)
    first, second = read_spans(recording)
    with pytest.raises(RecordingError, match=set_by):
        make_episode(recording.file, FrameSampling(fps=50), first)
    assert make_episode(recording.file, FrameSampling(fps=50), second).frames == 20


def test_ticks_keep_their_references_if_the_clock_is_set_and_a_tick_or_a_reference_is_lost(nodes: NodesOnFile) -> None:
    put = nodes.put
    for step, lost in ((5, names.REFERENCE), (-5, names.CONTROLLER_TICK), (5, names.CONTROLLER_TICK)):
        play(nodes, 20)
        nodes.put = lambda topic, *message, lost=lost: None if topic == lost else put(topic, *message)  # type: ignore[method-assign]
        play(nodes, 1, first=25, index=21)
        nodes.put = put  # type: ignore[method-assign]
        nodes.epoch += step * SECOND
        play(nodes, 20, first=26, index=22)
    chunks = ticks_in(nodes.close())
    assert sum(len(chunk.rows) for chunk in chunks) == 3 * (20 + 20)


def test_messages_that_do_not_fit_into_the_full_queue_are_lost_and_counted(tmp_path: Path) -> None:
    nodes = NodesOnFile(tmp_path, room=1 << 16)
    assert nodes.recorder.writer is not None
    os.kill(nodes.recorder.writer.pid, signal.SIGSTOP)
    play(nodes, 100)
    assert nodes.recorder.overflows > 0
    os.kill(nodes.recorder.writer.pid, signal.SIGCONT)
    nodes.close()
    assert nodes.recorder.written.messages == nodes.recorder.count - nodes.recorder.overflows


def test_reading_a_recording_of_an_external_controller_raises_an_error(tmp_path: Path) -> None:
    nodes = NodesOnFile(tmp_path, parse_config(yaml.safe_dump(external()), "the cell"))
    play(nodes, 5)
    with pytest.raises(RecordingError, match="recorded with controller: external"):
        ticks_in(nodes.close())


def test_uncompressed_pictures_cannot_be_exported_and_the_error_names_their_camera(tmp_path: Path) -> None:
    nodes = NodesOnFile(
        tmp_path, cell().model_copy(update={"cameras": {"front": CameraConfig(topic="/front/image_raw")}})
    )
    play(nodes, 5)
    with pytest.raises(RecordingError, match=r"camera front are sensor_msgs/Image.*--no-pictures"):
        list(open_recording(nodes.close()).pictures("front"))
