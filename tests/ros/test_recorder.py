"""The recorder's node: recorded messages of real nodes, episodes by controls and services, and faults."""

from __future__ import annotations

import json
import os
import platform
import re
import signal
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from q2r2_control.cameras.reasons import CameraReason
from q2r2_control.errors import NOT_RECORDED
from q2r2_control.events import Event
from q2r2_control.teleop.reasons import TeleopReason
from tests.ros.conftest import need_ros
from tests.ros.processes import CONFIG, Processes

need_ros()

from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from q2r2_control.errors import RecordingError
from q2r2_control.judging.episode import read_episode
from q2r2_control.judging.judge import judge
from q2r2_control.recording.bag import METADATA_FILE
from q2r2_control.recording.messages import RECORDER_EVENTS, TEXT, arm_events, data_of
from q2r2_control.recording.reader import Recording, read_spans
from q2r2_control.recording.ros_recording import open_recording
from q2r2_control.ros.base_node import RECORDED_QOS, STREAM_QOS
from q2r2_control.teleop.haptics import EPISODE_BEGINS, EPISODE_DISCARDED, EPISODE_ENDS, EPISODE_REJECTED, Pulse
from tests.cameras.videos import FPS, HEIGHT, WIDTH, number_of_jpeg, write_video
from tests.recording.runs import ROOT, read_elsewhere
from tests.ros.arm_rig import ArmRig
from tests.ros.processes import States, call, wait_until
from tests.support.processes import children

HAND = "/q2r_left_hand_pose"
HANDED_OVER = 20  # Number of messages that wait for the writer.


class RunningRecorder:
    def __init__(self, node: Any, processes: Processes, folder: Path) -> None:
        self.node, self._states = node, States(node, "recorder")
        self.process = processes.start_node("recorder", f"config:={CONFIG}", f"folder:={folder}", 'task:="3: blocks"')
        self.folder = Path(self.state()["file"] or folder).parent

    def state(self, **values: Any) -> dict[str, Any]:
        return self._states.wait_for(**values)

    def wait(self, key: str, value: object) -> None:
        wait_until(lambda: self.state()[key] == value, f"{key} is {value}")

    def poses(self) -> list[bytes]:
        """Return the hand's poses that the file contains so far."""
        with suppress(RecordingError):  # The recorder may be writing, so that the file is incomplete.
            recording = open_recording(self.folder)
            return [message.payload for messages in recording.messages((HAND,)) for message in messages]
        return []

    def discarded(self) -> list[bool]:
        """Return, for each episode that the file contains so far, whether it was discarded."""
        with suppress(RecordingError):  # The recorder may be writing, so that the file is incomplete.
            return [span.discarded for span in read_spans(open_recording(self.folder))]
        return []

    def end(self) -> Path:
        assert self.process.interrupt(60.0) == 0
        return self.folder


@pytest.fixture
def recorder(node: Any, processes: Processes, tmp_path: Path) -> RunningRecorder:
    return RunningRecorder(node, processes, tmp_path / "recordings")


def record_poses(recorder: RunningRecorder, node: Any, count: int) -> bytes:
    """Publish ``count`` poses of a hand, so slowly that best effort loses none.

    Wait until the last message is in the file. Return its first 8 bytes, which contain the seconds of its stamp.
    """
    publisher = node.create_publisher(PoseStamped, HAND, STREAM_QOS)
    message = PoseStamped()
    # Publisher and recorder discover each other at different times.
    wait_until(lambda: publisher.publish(message) or recorder.poses(), "the recorder takes poses")
    for number in range(count):
        message.pose.position.x = float(number)
        message.header.stamp.sec = 1000 + number
        publisher.publish(message)
        time.sleep(0.002)
    last = serialize_message(message)[:8]  # These bytes contain the seconds of the stamp.
    wait_until(lambda: recorder.poses()[-1].startswith(last), "the last pose is in the file")
    return last


def test_the_file_contains_messages_byte_for_byte_and_can_be_read_without_ros(
    recorder: RunningRecorder, node: Any, tmp_path: Path
) -> None:
    from rosbags.highlevel import AnyReader

    # Bytes between a message's fields are arbitrary memory of the sender. Compare with the bytes of another listener.
    heard: list[bytes] = []
    qos = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)  # The recorder uses the same depth.
    node.create_subscription(PoseStamped, HAND, heard.append, qos, raw=True)
    before = time.time_ns()
    strange = node.create_publisher(String, arm_events("left"), RECORDED_QOS)
    wait_until(strange.get_subscription_count, "the recorder listens to events")
    for text in ("{", "[]", '{"kind": "none"}'):
        strange.publish(String(data=text))
    last = record_poses(recorder, node, 100)
    wait_until(lambda: heard and heard[-1].startswith(last), "the test's node has heard the last one too")
    assert recorder.state()["lost_messages"] == 0
    folder = recorder.end()
    assert read_elsewhere(folder, tmp_path)[HAND]["count"] >= 100
    with AnyReader([folder]) as reader:
        messages = list(reader.messages([c for c in reader.connections if c.topic == HAND]))
    assert [bytes(data) for _, _, data in messages][-100:] == heard[-100:]
    assert all(before < received < time.time_ns() for _, received, _ in messages)
    about = Recording(folder).about
    assert about.notes["task"] == "3: blocks"
    assert Recording(folder).closed


def late_recorder(rig: ArmRig, node: Any, processes: Processes, folder: Path) -> RunningRecorder:
    """Press before a recorder runs, which is refused. Then start a recorder that the arm's node knows."""
    squeeze(rig)
    rig.wait(
        lambda: rig.state["last_event_kind"] == TeleopReason.NO_RECORDING, "without a recorder nothing is recorded"
    )
    recorder = RunningRecorder(node, processes, folder / "recordings")
    wait_until(lambda: node.count_subscribers("/recorder/state") > 1, "the arm's node listens to the recorder")
    for _ in range(3):
        recorder.state()
    return recorder


def test_presses_and_services_begin_and_end_the_same_episodes(node: Any, processes: Processes, tmp_path: Path) -> None:
    rig = ArmRig(node)
    rig.start(processes, {"teleop.bindings.grip": "record_toggle"})
    recorder = late_recorder(rig, node, processes, tmp_path)
    squeeze(rig)
    recorder.wait("episode_open", True)
    felt(rig, EPISODE_BEGINS)
    assert call(node, "/recorder/stop").success
    felt(rig, EPISODE_ENDS)
    refused = call(node, "/recorder/stop")
    assert not refused.success
    felt(rig, EPISODE_REJECTED)  # This vibration hides weaker ones, such as the vibration for a discard.
    squeeze(rig)
    recorder.wait("episode_open", True)
    assert call(node, "/recorder/discard").success
    felt(rig, EPISODE_DISCARDED)
    wait_until(lambda: recorder.discarded()[-1:] == [True], "the discard is in the file")
    kept, discarded = read_spans(open_recording(recorder.end()))
    assert (kept.discarded, discarded.discarded) == (False, True)


def test_presses_and_the_service_count_the_same_subtasks(node: Any, processes: Processes, tmp_path: Path) -> None:
    rig = ArmRig(node)
    rig.start(processes, {"teleop.bindings.grip": "next_subtask"})
    recorder = late_recorder(rig, node, processes, tmp_path)
    assert call(node, "/recorder/start").success
    recorder.wait("episode_open", True)
    squeeze(rig)
    recorder.wait("subtask", 2)
    answered = call(node, "/recorder/next_subtask")
    assert (answered.success, answered.message) == (True, "begins: subtask 3")
    felt(rig, EPISODE_BEGINS)
    assert call(node, "/recorder/stop").success
    refused = call(node, "/recorder/next_subtask")
    assert (refused.success, refused.message) == (False, "no next subtask: no episode goes on")
    (span,) = read_spans(open_recording(recorder.end()))
    assert len(span.subtask_starts) == 2
    assert list(span.subtask_starts) == sorted(span.subtask_starts)


def squeeze(rig: ArmRig) -> None:
    for rig.grip in (1.0, 0.0):
        time.sleep(0.2)


def felt(rig: ArmRig, pulse: Pulse) -> None:
    """Wait until a vibration has been felt and has ended. A weaker one that begins meanwhile is not felt."""
    wanted = (round(pulse.frequency, 3), round(pulse.amplitude, 3))
    rig.wait(lambda: wanted in rig.pulses and rig.pulses[-1] == (0.0, 0.0), f"{pulse} is felt")


@pytest.mark.alone
def test_a_killed_recorder_leaves_a_file_that_its_writer_closes(recorder: RunningRecorder, node: Any) -> None:
    """A kill loses the messages that the node has not passed on, and the messages of the chunk that is not written."""
    record_poses(recorder, node, 100)
    folder, (writer,) = recorder.folder, children(recorder.process.pid)
    os.kill(writer, signal.SIGSTOP)
    try:
        written, taken = len(recorder.poses()), recorder.state()["messages"]
        publisher = node.create_publisher(PoseStamped, HAND, STREAM_QOS)

        def sent() -> int:
            for _ in range(HANDED_OVER):
                publisher.publish(PoseStamped())
            return int(recorder.state()["messages"]) - taken

        # The count contains the messages of all topics. The newest of them may still be on the way to the pipe.
        wait_until(lambda: sent() >= 2 * HANDED_OVER, "the node hands over what is not written", patience=600.0)
        recorder.state()  # When this state has come, those messages are in the pipe.
        os.kill(recorder.process.pid, signal.SIGKILL)
    finally:
        os.kill(writer, signal.SIGCONT)
    wait_until((folder / METADATA_FILE).exists, "the bag is closed", patience=600.0)
    assert read_elsewhere(folder, folder.parent)[HAND]["count"] >= written + HANDED_OVER


def test_a_folder_that_cannot_be_written_is_an_error(node: Any, processes: Processes, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    recorder = RunningRecorder(node, processes, tmp_path / "file")
    recorder.state(level="error", records=False)
    assert not call(node, "/recorder/start").success
    assert recorder.process.interrupt(60.0) == NOT_RECORDED


def test_an_anonymous_recording_names_neither_the_operator_nor_the_computer(
    processes: Processes, tmp_path: Path
) -> None:
    notes = ("operator:=Ada", "anonymous:=true")
    process = processes.start_node("recorder", f"config:={CONFIG}", f"folder:={tmp_path}", *notes)
    process.wait_for("records to")
    assert process.interrupt(60.0) == 0
    about = open_recording(next(tmp_path.rglob("*.mcap"))).about
    assert "operator" not in about.notes
    assert platform.node() not in about.notes["machine"]
    assert "version" in about.notes


def cell_with_camera(folder: Path, video: Path) -> Path:
    text = (ROOT / CONFIG).read_text(encoding="utf-8")
    camera = {"device": str(video), "width": WIDTH, "height": HEIGHT, "rate": FPS, "repeat": False}
    text = re.sub(r"(?ms)^cameras:.*?(?=^judge:)", f"cameras: {json.dumps({'front': camera})}\n\n", text)
    (file := folder / "cell.yaml").write_text(text, encoding="utf-8")
    return file


def test_pictures_of_a_device_are_recorded_with_the_time_of_their_capture(
    node: Any, processes: Processes, tmp_path: Path
) -> None:
    cell = cell_with_camera(tmp_path, write_video(tmp_path / "front.avi", range(50)))
    process = processes.start_node("recorder", f"config:={cell}", f"folder:={tmp_path / 'recordings'}")
    process.wait_for("camera front: no picture for")
    process.wait_for("the video has ended")
    assert process.interrupt(60.0) == 0
    recording = open_recording(tmp_path / "recordings")
    assert recording.about.cameras == ("front",)
    pictures = list(recording.pictures("front"))
    numbers = np.array([number_of_jpeg(picture.jpeg) for picture in pictures])
    np.testing.assert_array_equal(numbers, np.arange(numbers[0], 50))
    times = np.array([picture.time - pictures[0].time for picture in pictures]) * 1e-9
    np.testing.assert_allclose(times, (numbers - numbers[0]) / FPS, atol=1e-6)
    (told,) = [message for messages in recording.messages((RECORDER_EVENTS,)) for message in messages]
    assert CameraReason.CAMERA_STOPPED in data_of(told.payload, TEXT)


def test_a_recorder_whose_camera_gives_no_picture_ends_with_one_line(processes: Processes, tmp_path: Path) -> None:
    pytest.importorskip("cv2")
    process = processes.start_node("recorder", f"config:={cell_with_camera(tmp_path, tmp_path / 'none.avi')}")
    process.wait_for("recorder: cameras.front.device: ")
    assert process.wait() == 2


@pytest.mark.slow
@pytest.mark.alone
def test_a_whole_set_is_recorded_and_judged_and_ends_at_ctrl_c(node: Any, processes: Processes, tmp_path: Path) -> None:
    process = processes.start(
        *(sys.executable, "-m", "q2r2_control", "ros", "up", CONFIG, "--record", str(tmp_path), "--operator", "Ada"),
        name="up",
    )
    for arm in ("left", "right"):
        process.wait_for(f"[{arm}_q2r2_arm_controller]", 120.0)
    process.wait_for("engaged: ", 120.0)
    told: list[Event] = []
    node.create_subscription(
        String, RECORDER_EVENTS, lambda event: told.append(Event.from_json(json.loads(event.data))), RECORDED_QOS
    )
    assert call(node, "/recorder/start").success
    states = States(node, "recorder")
    enough = states.wait_for()["messages"] + 10_000  # Each tick has about 10 messages.
    wait_until(lambda: states.wait_for()["messages"] > enough, "the arms are moved", patience=600.0)
    assert call(node, "/recorder/stop").success
    # Nodes with real-time priority can use all processors. They are stopped, so that the judging process gets time.
    others = [pid for pid in children(process.pid) if "recorder" not in Path(f"/proc/{pid}/cmdline").read_text()]
    for pid in others:
        os.kill(pid, signal.SIGSTOP)
    wait_until(lambda: any(event.kind is TeleopReason.VERDICT for event in told), "the verdict is told", patience=600.0)
    for pid in others:
        os.kill(pid, signal.SIGCONT)
    assert process.interrupt(600.0) == 0
    (file,) = tmp_path.glob("*/*.mcap")
    recording = open_recording(file)
    (judged,) = judge(recording)
    assert judged.figures.timing.ended
    assert judged.figures.timing.ticks > 100
    assert read_episode(recording).ticks.engaged.any(), "they were before the episode began"
    assert recording.about.notes["operator"] == "Ada"
